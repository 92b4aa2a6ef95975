/* One agent: memory, and its part in a slot. */
#include <math.h>
#include <string.h>

#include "avoider/avoider.h"
#include "policy/policy.h"

int dtsa_version(void) { return DTSA_VERSION; }

/* ---- configuration ---- */

const char *dtsa_config_fault(const dtsa_config *c)
{
    const policy_row *policy = policy_of(c->policy);
    if (c->agents < 1 || c->agents > DTSA_AGENTS_MAX) return "agents";
    if (!(c->slot_s > 0.0)) return "slot_s";
    if (c->steps < 1) return "steps";
    if (!policy) return "policy";
    if (c->estimator < 0 || c->estimator > DTSA_ESTIMATE_EXTERNAL) return "estimator";
    if (c->avoider < 0 || c->avoider >= DTSA_AVOID_COUNT) return "avoider";
    if (c->selection < 0 || c->selection >= DTSA_SELECT_COUNT) return "selection";
    if (c->profile < 0 || c->profile >= DTSA_PROFILE_COUNT) return "profile";
    const int extended = c->profile == DTSA_PROFILE_EXTENDED;
    if (policy->needs_extended && !extended) return "profile";
    if (extended && c->agents > DTSA_EXTENDED_AGENTS_MAX) return "agents";
    if (c->c_r < 1 || c->c_r > 255) return "c_r";
    if (!(c->position_step > 0.0)) return "position_step";
    if (!c->start || !c->target) return "start";
    if (c->estimator == DTSA_ESTIMATE_INTENT && (!c->decay || c->decay_len < 1)) return "decay";
    if (policy->bytes && (c->lease.anchor_every < 1 || c->lease.anchor_every > 15))
        return "anchor_every";
    if (policy->bytes && (c->lease.main_every < 0 || c->lease.main_every > 15 ||
                          c->lease.main_every % c->lease.anchor_every))
        return "main_every";
    return c->lease.open_every < 0 ? "open_every" : NULL;
}

uint64_t common_factor(uint64_t a, uint64_t b)
{
    while (b) {
        const uint64_t rest = a % b;
        a = b;
        b = rest;
    }
    return a;
}

uint64_t dtsa_slot_cycle(const dtsa_config *c)
{
    const int rounds = c->lease.main_every ? c->lease.main_every : c->lease.anchor_every;
    const uint64_t turns = (uint64_t)c->agents * (uint64_t)(rounds > 0 ? rounds : 1) * 2,
                   open = c->lease.open_every > 0 ? (uint64_t)c->lease.open_every : 1,
                   all = turns / common_factor(turns, open) * open;
    return ((uint64_t)1 << 32) / all * all;
}

uint32_t slot_on_air(const dtsa_config *c, int64_t slot)
{
    return slot >> 31 ? (uint32_t)((uint64_t)slot % dtsa_slot_cycle(c)) : (uint32_t)slot;
}

/* ---- memory ---- */

/* Hands out parts of one block; with no block it only counts. */
typedef struct arena {
    uint8_t *block;
    size_t used;
} arena;

static void *part(arena *a, size_t count, size_t size)
{
    void *at = a->block ? a->block + a->used : NULL;
    a->used = (a->used + count * size + 7) / 8 * 8;
    return at;
}

static dtsa_agent *lay_out(arena *m, const dtsa_config *c)
{
    const size_t n = (size_t)c->agents;
    const policy_row *policy = policy_of(c->policy);
    dtsa_agent *a = part(m, 1, sizeof *a);
    dtsa_table t = {.config = c}, *table = part(m, 1, sizeof t);
    t.sent_p = part(m, 3 * n, sizeof(double));
    t.sent_v = part(m, 3 * n, sizeof(double));
    t.sent_c = part(m, 3 * n, sizeof(double));
    t.innovation = part(m, n, sizeof(double));
    t.sent_slot = part(m, n, sizeof(int64_t));
    t.last = part(m, n, sizeof(int64_t));
    t.entry_hash = part(m, n, sizeof(uint32_t));
    t.hash = part(m, 1, sizeof(uint32_t));
    t.in_ap = part(m, n, 1);
    t.est_p = part(m, 3 * n, sizeof(double));
    t.est_v = part(m, 3 * n, sizeof(double));
    t.g = part(m, n, sizeof(double));
    t.h = part(m, n, sizeof(int64_t));
    t.ages = part(m, n, sizeof(double));
    t.scratch = part(m, (size_t)scratch_doubles(c->agents), sizeof(double));
    void *state = policy->bytes ? part(m, policy->bytes(c), 1) : NULL;
    if (!m->block) return NULL;
    *table = t;
    a->table = table;
    a->policy = policy;
    a->state = state;
    return a;
}

size_t dtsa_agent_bytes(const dtsa_config *c)
{
    arena counter = {NULL, 0};
    if (dtsa_config_fault(c)) return 0;
    lay_out(&counter, c);
    return counter.used;
}

dtsa_agent *dtsa_agent_start(void *memory, size_t bytes, const dtsa_config *c, int id)
{
    const size_t needed = dtsa_agent_bytes(c);
    if (!memory || !needed || bytes < needed || (uintptr_t)memory % sizeof(double)) return NULL;
    if (id < 1 || id > c->agents) return NULL;
    memset(memory, 0, needed);
    arena block = {memory, 0};
    dtsa_agent *a = lay_out(&block, c);
    a->table->observer = a->self = id - 1;
    for (int i = 0; i < 3; i++) {
        a->position[i] = c->start[i * c->agents + a->self];
        a->goal[i] = c->target[i * c->agents + a->self];
    }
    a->present = a->active = a->final = 1;
    agent_forget(a);
    return a;
}

/* ---- what happens to an agent ---- */

void agent_forget(dtsa_agent *a)
{
    table_reset(a->table);
    if (a->policy->begin) a->policy->begin(a);
}

void dtsa_agent_restart(dtsa_agent *a)
{
    agent_forget(a);
    a->frame_length = 0;
}

void dtsa_agent_switch(dtsa_agent *a, int on)
{
    if (!on) agent_forget(a);
    if (!on || !a->present) a->present = on != 0;
}

void dtsa_agent_leave(dtsa_agent *a)
{
    if (a->present && a->policy->says_leaving)
        a->present = PRESENT_LEAVING;
    else
        dtsa_agent_switch(a, 0);
}

int dtsa_agent_is_on(const dtsa_agent *a) { return a->present != 0; }

void dtsa_agent_hover(dtsa_agent *a, int hovers) { a->active = !hovers; }

void dtsa_agent_set_state(dtsa_agent *a, const double position[3], const double velocity[3])
{
    for (int i = 0; i < 3; i++) {
        a->position[i] = position[i];
        a->velocity[i] = velocity[i];
    }
}

void dtsa_agent_set_goal(dtsa_agent *a, const double goal[3], int final)
{
    for (int i = 0; i < 3; i++) a->goal[i] = goal[i];
    a->final = final != 0;
}

int agent_far_from_goal(const dtsa_agent *a)
{
    double e2 = 0.0;
    for (int i = 0; i < 3; i++) {
        const double d = a->goal[i] - a->position[i];
        e2 += d * d;
    }
    return sqrt(e2) > a->table->config->r_min;
}

/* ---- a slot ---- */

void agent_decide(dtsa_agent *a, int64_t slot)
{
    const choice c = a->policy->decide(a, slot);
    a->decision = (dtsa_decision){.chosen = c.index + 1,
                                  .reason = c.reason,
                                  .sends = c.index == a->self && a->present,
                                  .score = c.score,
                                  .digest = *a->table->hash};
}

int agent_speak(dtsa_agent *a, int64_t slot, uint8_t *out)
{
    const dtsa_config *c = a->table->config;
    extended_frame e = {.own = {.profile = c->profile, .sender = a->self + 1}};
    e.own.slot = slot_on_air(c, slot);
    e.own.c_r = agent_far_from_goal(a) ? c->c_r : 0;
    for (int i = 0; i < 3; i++) {
        e.own.p[i] = a->position[i];
        e.own.v[i] = a->velocity[i];
        e.own.c[i] = a->command[i];
    }
    if (c->profile != DTSA_PROFILE_EXTENDED) return frame_encode(&e.own, c->position_step, out);
    if (a->policy->speak) a->policy->speak(a, slot, &e);
    const int used =
        (e.lease_count + SECTION_BYTES - 1) / SECTION_BYTES + (e.relay_mask != 0) + (e.far_id != 0);
    if (c->gossip)
        e.gossip_count = gossip_collect(a->table, a->self, slot, SECTIONS - used, e.gossip);
    return extended_encode(&e, c->position_step, out);
}

int dtsa_agent_slot(dtsa_agent *a, int64_t slot, uint8_t frame[DTSA_FRAME_MAX])
{
    agent_decide(a, slot);
    a->frame_length = 0;
    if (!a->decision.sends) return 0;
    a->frame_length = (uint8_t)agent_speak(a, slot, a->frame);
    memcpy(frame, a->frame, a->frame_length);
    return a->frame_length;
}

void dtsa_agent_unsent(dtsa_agent *a) { a->frame_length = 0; }

dtsa_decision dtsa_agent_decision(const dtsa_agent *a) { return a->decision; }

int dtsa_agent_hear(dtsa_agent *a, int64_t slot, const uint8_t *data, long length)
{
    heard_frame heard;
    const int verdict = frame_admit(a->table->config, slot, data, length, &heard);
    a->malformed += verdict == HEARD_MALFORMED;
    a->foreign += verdict == HEARD_FOREIGN;
    if (verdict == HEARD && a->present) agent_take(a, &heard);
    return verdict == HEARD;
}

void dtsa_agent_end(dtsa_agent *a, int64_t slot)
{
    if (a->frame_length) agent_said(a, slot, a->frame, a->frame_length);
    a->policy->end(a, slot);
}

/* ---- flight ---- */

void agent_steer(dtsa_agent *a, int64_t slot, int step)
{
    dtsa_table *t = a->table;
    const dtsa_config *c = t->config;
    const double *ages = NULL;
    if (c->avoid.margin_rate > 0.0) {
        const double dt = c->slot_s / c->steps;
        for (int k = 0; k < c->agents; k++)
            t->ages[k] = t->sent_slot[k] < 0 || !t->in_ap[k] /* it rests where it was heard */
                             ? 0.0
                             : (double)(slot - t->sent_slot[k]) * c->slot_s + step * dt;
        ages = t->ages;
    }
    avoid_command(c->avoider, &c->avoid, c->agents, a->self, a->position, a->velocity, a->goal,
                  t->est_p, t->est_v, ages, t->scratch, a->command);
}

void dtsa_agent_command(dtsa_agent *a, int64_t slot, int step, double command[3])
{
    if (a->active && a->present) {
        table_estimate(a->table, slot, step);
        agent_steer(a, slot, step);
    } else {
        for (int i = 0; i < 3; i++) a->command[i] = 0.0;
    }
    for (int i = 0; i < 3; i++) command[i] = a->command[i];
}

dtsa_status dtsa_agent_status(const dtsa_agent *a)
{
    dtsa_status status = {.malformed = a->malformed, .foreign = a->foreign, .woke = -1};
    if (a->policy->status) a->policy->status(a, &status);
    return status;
}
