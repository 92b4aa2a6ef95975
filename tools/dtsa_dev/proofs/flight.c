/* The same flights on any machine: 200 slots of each policy, N = 12 and 18, a tenth of all
 * receptions lost. Prints a digest of all frames, decisions, tables and commands; on a
 * microcontroller also memory, stack and instructions per call. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core.h"
#include "meter.h"

#ifndef SLOTS
#define SLOTS 200
#endif
enum { MOST = 18 };

static double memory[MOST][1200];
static double places[6 * MOST], positions[MOST][3], velocities[MOST][3];

static void configure(dtsa_config *c, int policy, int n)
{
    memset(c, 0, sizeof *c);
    c->agents = n;
    c->slot_s = 0.01;
    c->steps = 1;
    c->policy = policy;
    c->estimator = DTSA_ESTIMATE_LINEAR;
    c->avoider = DTSA_AVOID_ORCA;
    c->profile = policy == DTSA_POLICY_LEASE ? DTSA_PROFILE_EXTENDED : DTSA_PROFILE_PAPER;
    c->epsilon = 0.5;
    c->age_cap = 1.5;
    c->boot_round = 1;
    c->return_every = 20;
    c->r_min = 0.3;
    c->c_r = 1;
    c->targets_known = c->gossip = 1;
    c->position_step = 0.002;
    c->key = 12345;
    c->avoid = (dtsa_avoid_params){1.5,  2.0, 0.336, 1.0, 30.0, 0.2,  0.2, 1.31,
                                   0.33, 0.1, 0.3,   0.0, 0.3,  0.25, 1.0};
    c->lease = (dtsa_lease_config){3, 11, 1, 0.5, 1.0, 0, 15};
    for (int k = 0; k < n; k++) { /* a wavy square; most cross it, two rest */
        const double side = 0.8 * (k / 4 + 1), far = k < n - 2 ? -1.0 : 1.0;
        const double x = k & 1 ? side : -side, y = k & 2 ? 2.5 : -2.5, z = 1.0 + 0.1 * (k % 5);
        places[k] = x;
        places[n + k] = y;
        places[2 * n + k] = z;
        places[3 * n + k] = far * x;
        places[4 * n + k] = far * y;
        places[5 * n + k] = z;
    }
    c->start = places;
    c->target = places + 3 * n;
}

static uint64_t hash;

static void digest(const void *data, size_t size)
{
    for (size_t i = 0; i < size; i++) hash = mix64(hash ^ ((const uint8_t *)data)[i]);
}

static void fly_one(dtsa_agent *a, int k, int64_t slot)
{
    double command[3];
    meter_begin();
    dtsa_agent_command(a, slot, 0, command);
    meter_end(METER_COMMAND);
    digest(command, sizeof command);
    for (int i = 0; i < 3; i++) {
        velocities[k][i] += 0.04 * (command[i] - velocities[k][i]);
        positions[k][i] += 0.01 * velocities[k][i];
    }
}

static void one_slot(dtsa_agent **agents, int n, int64_t slot)
{
    static uint8_t frames[MOST][DTSA_FRAME_MAX];
    static int lengths[MOST];
    int senders = 0, last = 0;
    for (int k = 0; k < n; k++) {
        dtsa_agent_set_state(agents[k], positions[k], velocities[k]);
        meter_begin();
        lengths[k] = dtsa_agent_slot(agents[k], slot, frames[k]);
        meter_end(METER_SLOT);
        const dtsa_decision d = dtsa_agent_decision(agents[k]);
        const int32_t words[4] = {d.chosen, d.reason, d.sends, (int32_t)d.digest};
        digest(words, sizeof words);
        digest(&d.score, sizeof d.score);
        digest(frames[k], (size_t)lengths[k]);
        if (lengths[k]) senders++, last = k;
    }
    for (int k = 0; k < n; k++) fly_one(agents[k], k, slot);
    for (int k = 0; k < n && senders == 1; k++) {
        if (k == last || draw_uniform(99, (uint64_t)slot * MOST + (uint64_t)k) < 0.1) continue;
        meter_begin();
        dtsa_agent_hear(agents[k], slot, frames[last], lengths[last]);
        meter_end(METER_HEAR);
    }
    for (int k = 0; k < n; k++) {
        meter_begin();
        dtsa_agent_end(agents[k], slot);
        meter_end(METER_END);
    }
}

static int fly(int policy, int n)
{
    dtsa_config c;
    dtsa_agent *agents[MOST];
    configure(&c, policy, n);
    const size_t bytes = dtsa_agent_bytes(&c);
    meter_reset();
    hash = 0;
    for (int k = 0; k < n; k++) {
        agents[k] = dtsa_agent_start(memory[k], sizeof memory[k], &c, k + 1);
        if (!agents[k]) return 1;
        for (int i = 0; i < 3; i++) {
            positions[k][i] = places[i * n + k];
            velocities[k][i] = 0.0;
        }
    }
    for (int64_t slot = 0; slot < SLOTS; slot++) one_slot(agents, n, slot);
    printf("%s %d %08lx%08lx %lu", dtsa_names(0)->names[policy], n, (unsigned long)(hash >> 32),
           (unsigned long)(hash & 0xffffffffu), (unsigned long)bytes);
    meter_print();
    return 0;
}

int main(void)
{
    static const int POLICIES[] = {DTSA_POLICY_TDMA, DTSA_POLICY_DTSA, DTSA_POLICY_LEASE};
    int failed = 0;
    for (int i = 0; i < 3; i++)
        for (int n = 12; n <= MOST; n += 6) failed |= fly(POLICIES[i], n);
    return failed;
}
