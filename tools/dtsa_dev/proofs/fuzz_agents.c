/* Fuzzed: streams of events. The first bytes choose the settings; then each byte is an event of one
 * of two agents: a slot (with or without the other's frame, changed or not), a slot number, a
 * state, a goal, a restart, a leave, a frame of any bytes; and tags are opened. Nothing may crash,
 * and a digest stays one. */
#include <stdlib.h>
#include <string.h>

#include "core.h"
#include "dtsa.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

enum { AGENTS = 2, MOST = 24 };

typedef struct input {
    const uint8_t *at;
    size_t left;
} input;

static unsigned next(input *in)
{
    if (!in->left) return 0;
    in->left--;
    return *in->at++;
}

static void fill(input *in, void *to, size_t size)
{
    for (size_t i = 0; i < size; i++) ((uint8_t *)to)[i] = (uint8_t)next(in);
}

static double metres(input *in) { return ((int)next(in) - 128) * 0.1; }

static void configure(input *in, dtsa_config *c, double *places)
{
    static double decay[2 * 64];
    static const int PROFILES[] = {DTSA_PROFILE_PAPER, DTSA_PROFILE_PAPER_INTENT,
                                   DTSA_PROFILE_EXTENDED};
    memset(c, 0, sizeof *c);
    c->agents = AGENTS + (int)(next(in) % (MOST - AGENTS + 1));
    c->slot_s = 0.01;
    c->steps = 1 + (int)(next(in) % 3);
    c->policy = (int)(next(in) % (DTSA_POLICY_EXTERNAL + 1));
    c->estimator = (int)(next(in) % DTSA_ESTIMATE_ORACLE);
    c->avoider = (int)(next(in) % DTSA_AVOID_COUNT);
    c->selection = (int)(next(in) % DTSA_SELECT_COUNT);
    c->profile = c->policy == DTSA_POLICY_LEASE ? DTSA_PROFILE_EXTENDED : PROFILES[next(in) % 3];
    c->epsilon = 0.5;
    c->age_cap = (double)(next(in) % 3);
    c->boot_round = (int)(next(in) & 1);
    c->return_every = (int)(next(in) % 21);
    c->r_min = 0.3;
    c->c_r = 1;
    c->targets_known = (int)(next(in) & 1);
    c->gossip = (int)(next(in) & 1);
    c->position_step = 0.002;
    c->key = next(in);
    c->avoid = (dtsa_avoid_params){1.5,  2.0, 0.336, 1.0, 30.0, 0.2,  0.2, 1.31,
                                   0.33, 0.1, 0.3,   0.0, 0.3,  0.25, 1.0};
    c->avoid.margin_rate = (next(in) & 1) * 0.2;
    c->lease = (dtsa_lease_config){1 + (int)(next(in) % 15),
                                   (int)(next(in) % 12),
                                   (int)(next(in) & 1),
                                   2.0,
                                   1.0,
                                   (int64_t)next(in),
                                   0};
    c->lease.main_every =
        c->lease.anchor_every * (1 + (int)next(in) % (15 / c->lease.anchor_every));
    for (int i = 0; i < 6 * c->agents; i++) places[i] = i * 0.7;
    c->start = places;
    c->target = places + 3 * c->agents;
    dtsa_decay(0.25, 0.01, 64, decay);
    c->decay = decay;
    c->decay_len = 64;
}

static uint32_t digest_of(const dtsa_agent *a)
{
    uint32_t hash = 0;
    for (int k = 0; k < a->table->config->agents; k++) hash ^= a->table->entry_hash[k];
    return hash;
}

static void event(input *in, dtsa_agent **agents, const dtsa_config *c, int64_t *slot)
{
    const unsigned what = next(in), who = what >> 7;
    uint8_t frames[AGENTS][DTSA_FRAME_MAX], bytes[DTSA_FRAME_MAX + 4];
    double p[3], v[3], command[3];
    dtsa_agent *a = agents[who];
    switch (what & 7) {
    case 0: /* a slot of both; bits say who hears whom, and whether a byte is changed on its way */
    case 1:
        for (int i = 0; i < AGENTS; i++) {
            const int length = dtsa_agent_slot(agents[i], *slot, frames[i]);
            memset(frames[i] + length, 0, (size_t)(DTSA_FRAME_MAX - length));
        }
        if (what & 8) frames[who][next(in) % DTSA_FRAME_MAX] ^= (uint8_t)next(in);
        for (int i = 0; i < AGENTS; i++)
            if (what >> (4 + i) & 1 && agents[i]->frame_length)
                dtsa_agent_hear(agents[!i], *slot + (what >> 6 & 1), frames[i],
                                agents[i]->frame_length);
        for (int i = 0; i < AGENTS; i++) {
            dtsa_agent_command(agents[i], *slot, 0, command);
            for (int axis = 0; axis < 3; axis++)
                if (command[axis] != command[axis]) abort();
            dtsa_agent_end(agents[i], *slot);
        }
        ++*slot;
        break;
    case 2:
        *slot += (int64_t)next(in) * (what & 8 ? 64 : 1);
        break;
    case 3:
        for (int i = 0; i < 3; i++) {
            p[i] = metres(in);
            v[i] = 0.1 * metres(in);
        }
        dtsa_agent_set_state(a, p, v);
        if (what & 8) dtsa_agent_set_goal(a, p, what >> 4 & 1);
        break;
    case 4:
        dtsa_agent_restart(a);
        break;
    case 5:
        if (what & 8)
            dtsa_agent_leave(a);
        else
            dtsa_agent_switch(a, what >> 4 & 1);
        break;
    case 6: { /* any bytes, the header helped along */
        const long length = (long)(next(in) % sizeof bytes);
        fill(in, bytes, (size_t)length);
        if (length > 8 && what & 8) {
            bytes[0] = (uint8_t)(FRAME_VERSION << 4 | c->profile);
            for (int i = 0; i < 4; i++) bytes[4 + i] = (uint8_t)(*slot >> 8 * i);
            dtsa_agent_hear(a, *slot, bytes,
                            frame_length(c->profile) < length ? frame_length(c->profile) : length);
        }
        dtsa_agent_hear(a, *slot, bytes, length);
        dtsa_open(bytes, 16, 1, *slot, 1, bytes, length);
        break;
    }
    default:
        dtsa_agent_status(a);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static double places[6 * MOST];
    input in = {data, size};
    dtsa_config c;
    dtsa_agent *agents[AGENTS];
    configure(&in, &c, places);
    const size_t bytes = dtsa_agent_bytes(&c);
    if (!bytes) abort();
    for (int i = 0; i < AGENTS; i++) {
        /* exactly as many bytes as it asks for: one more is somebody else's */
        agents[i] = dtsa_agent_start(malloc(bytes), bytes, &c, i + 1);
        if (!agents[i]) abort();
    }
    int64_t slot = next(&in) & 1 ? 0 : 1000;
    for (int i = 0; i < 400 && in.left; i++) {
        event(&in, agents, &c, &slot);
        for (int k = 0; k < AGENTS; k++)
            if (digest_of(agents[k]) != *agents[k]->table->hash) abort();
    }
    for (int i = 0; i < AGENTS; i++) free(agents[i]);
    return 0;
}
