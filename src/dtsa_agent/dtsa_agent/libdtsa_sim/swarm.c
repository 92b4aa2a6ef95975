/* Agents in slots, many at once: the same agents that libdtsa makes one of, on arrays of a caller.
 *
 * A slot i, in this order: decide and emit (from what was heard before slot i), fly, hear (what the
 * air carried in slot i), end. Without loss one table can serve all, because every agent then hears
 * the same and computes the same.
 */
#include "swarm.h"

#include <stdlib.h>
#include <string.h>

#include "avoider/avoider.h"

size_t swarm_policy_bytes(const dtsa_config *c)
{
    const policy_row *policy = policy_of(c->policy);
    return policy && policy->bytes ? policy->bytes(c) : 0;
}

/* ---- made, reset ---- */

static void open_table(swarm *s, int table)
{
    const long n = s->config.agents, at = table * n, plane = 3 * at;
    s->tables[table] = (dtsa_table){
        .config = &s->config,
        .observer = s->observer[table],
        .sent_p = s->sent_position + plane,
        .sent_v = s->sent_velocity + plane,
        .sent_c = s->sent_intent + plane,
        .innovation = s->innovation + at,
        .sent_slot = s->sent_slot + at,
        .last = s->last_turn + at,
        .in_ap = s->in_ap + at,
        .entry_hash = s->entry_hash + at,
        .hash = s->table_hash + table,
        .est_p = s->estimate_position + plane,
        .est_v = s->estimate_velocity + plane,
        .g = s->priority + at,
        .h = s->counter + at,
        .scratch = s->scratch,
        .ages = s->ages,
    };
}

static const char *check(const swarm *s)
{
    const char *fault = dtsa_config_fault(&s->config);
    if (fault) return fault;
    if (s->local_count && s->table_count < (s->shared ? 1 : s->local_count)) return "table_count";
    for (int l = 0; l < s->local_count; l++)
        if (s->local[l] < 0 || s->local[l] >= s->config.agents) return "local";
    for (int v = 0; v < s->table_count; v++)
        if (s->observer[v] < -1 || s->observer[v] >= s->config.agents) return "observer";
    return s->shared && swarm_policy_bytes(&s->config) ? "shared" : NULL;
}

const char *swarm_open(swarm *s)
{
    const char *fault = check(s);
    const size_t n = (size_t)s->config.agents, l = (size_t)s->local_count;
    const size_t bytes = swarm_policy_bytes(&s->config);
    if (fault) return fault;
    s->scratch = calloc((size_t)scratch_doubles(s->config.agents), sizeof(double));
    s->ages = calloc(n, sizeof(double));
    s->tables = calloc((size_t)s->table_count + 1, sizeof *s->tables);
    s->agents = calloc(l + 1, sizeof *s->agents);
    if (!s->scratch || !s->ages || !s->tables || !s->agents) return "memory";
    for (int v = 0; v < s->table_count; v++) open_table(s, v);
    for (int i = 0; i < s->local_count; i++)
        s->agents[i] = (dtsa_agent){
            .table = &s->tables[s->shared ? 0 : i],
            .policy = policy_of(s->config.policy),
            .state = bytes ? s->lease_state + (size_t)i * bytes : NULL,
            .self = s->local[i],
        };
    swarm_reset(s);
    return NULL;
}

void swarm_close(swarm *s)
{
    free(s->scratch);
    free(s->ages);
    free(s->tables);
    free(s->agents);
}

void swarm_reset(swarm *s)
{
    const int n = s->config.agents, count = s->local_count;
    for (int table = 0; table < s->table_count; table++) table_reset(&s->tables[table]);
    for (int l = 0; l < count; l++) {
        for (int i = 0; i < 3; i++) {
            const double p = s->config.start[i * n + s->local[l]];
            s->position[i * count + l] = p;
            s->velocity[i * count + l] = s->command[i * count + l] = 0.0;
            s->goal[i * count + l] = s->config.target[i * n + s->local[l]];
            for (int step = 0; step < s->config.steps; step++)
                s->track[(step * 3 + i) * count + l] = p;
        }
        s->active[l] = s->present[l] = 1;
        s->frame_length[l] = s->sends[l] = 0;
        if (s->agents[l].policy->begin) s->agents[l].policy->begin(&s->agents[l]);
    }
    s->sender_count = 0;
    s->rejects[0] = s->rejects[1] = 0;
}

void swarm_restart(swarm *s, int l) { agent_forget(&s->agents[l]); }

/* ---- decisions and frames ---- */

static void take_vector(const swarm *s, const double *planes, int l, double out[3])
{
    for (int i = 0; i < 3; i++) out[i] = planes[i * s->local_count + l];
}

/* The arrays are what counts: whoever holds them may have changed them. */
static dtsa_agent *agent_at(swarm *s, int l)
{
    dtsa_agent *a = &s->agents[l];
    a->present = s->present[l];
    take_vector(s, s->position, l, a->position);
    take_vector(s, s->goal, l, a->goal);
    return a;
}

void swarm_decide(swarm *s, int64_t slot)
{
    const policy_row *policy = policy_of(s->config.policy);
    for (int l = 0; l < s->local_count; l++) {
        dtsa_agent *a = agent_at(s, l);
        if (l && s->shared && policy->by_table) {
            a->decision = s->agents[0].decision;
            a->decision.sends = a->decision.chosen == a->self + 1 && a->present;
        } else {
            agent_decide(a, slot);
        }
        s->chosen[l] = (uint16_t)a->decision.chosen;
        s->reason[l] = (uint8_t)a->decision.reason;
        s->score[l] = a->decision.score;
        s->digest[l] = a->decision.digest;
        s->sends[l] = (uint8_t)a->decision.sends;
    }
}

int swarm_emit(swarm *s, int64_t slot)
{
    s->sender_count = 0;
    for (int l = 0; l < s->local_count; l++) {
        s->frame_length[l] = 0;
        if (!s->sends[l]) continue;
        dtsa_agent *a = agent_at(s, l);
        a->final = s->final[l];
        take_vector(s, s->velocity, l, a->velocity);
        take_vector(s, s->command, l, a->command);
        s->frame_length[l] = (uint8_t)agent_speak(a, slot, s->frames + (long)l * DTSA_FRAME_MAX);
        if (s->frame_length[l]) s->senders[s->sender_count++] = l;
    }
    return s->sender_count;
}

int swarm_begin(swarm *s, int64_t slot)
{
    swarm_decide(s, slot);
    return swarm_emit(s, slot);
}

/* ---- what the air carried ---- */

int swarm_hear(swarm *s, int64_t slot, const uint8_t *data, long length, const uint8_t *mask)
{
    heard_frame heard;
    const int verdict = frame_admit(&s->config, slot, data, length, &heard);
    s->rejects[0] += verdict == HEARD_MALFORMED;
    s->rejects[1] += verdict == HEARD_FOREIGN;
    if (verdict != HEARD) return 0;
    const int extended = s->config.profile == DTSA_PROFILE_EXTENDED;
    const int sender = heard.e.own.sender - 1;
    for (int v = 0; v < s->table_count; v++) {
        const int speaks = extended && s->observer[v] == sender;
        if (speaks ? s->local_count > 0 : mask && !mask[v])
            continue; /* a local sender knows what it said */
        if (v >= s->local_count || s->shared)
            table_take(&s->tables[v], &heard);
        else if (!extended || s->present[v])
            agent_take(&s->agents[v], &heard);
    }
    return 1;
}

void swarm_end(swarm *s, int64_t slot)
{
    const int count = s->shared ? s->local_count > 0 : s->local_count;
    for (int i = 0; i < s->sender_count; i++) {
        const int l = s->senders[i];
        s->agents[l].decision.reason = s->reason[l];
        agent_said(&s->agents[l], slot, s->frames + (long)l * DTSA_FRAME_MAX, s->frame_length[l]);
    }
    for (int l = 0; l < count; l++) {
        dtsa_agent *a = &s->agents[l];
        a->present = s->present[l];
        a->decision.chosen = s->chosen[l];
        a->decision.reason = s->reason[l];
        a->decision.sends = s->sends[l];
        a->policy->end(a, slot);
        s->present[l] = a->present;
    }
}

/* ---- flight ---- */

void swarm_estimate(swarm *s, int table, int64_t slot, int step)
{
    dtsa_table *t = &s->tables[table];
    const int n = s->config.agents;
    if (s->config.estimator != DTSA_ESTIMATE_ORACLE) {
        table_estimate(t, slot, step);
        return;
    }
    for (int l = 0; l < s->local_count; l++)
        for (int i = 0; i < 3; i++) {
            t->est_p[i * n + s->local[l]] = s->position[i * s->local_count + l];
            t->est_v[i * n + s->local[l]] = s->velocity[i * s->local_count + l];
        }
}

void swarm_estimate_all(swarm *s, int64_t slot, int step)
{
    for (int table = 0; table < s->table_count; table++) swarm_estimate(s, table, slot, step);
}

void swarm_steer(swarm *s, int64_t slot, int step, int estimate)
{
    const int count = s->local_count;
    for (int l = 0; l < count; l++) {
        const int flies = s->active[l] && s->present[l];
        dtsa_agent *a = &s->agents[l];
        if ((flies || (l == 0 && s->shared)) && estimate && (l == 0 || !s->shared))
            swarm_estimate(s, s->shared ? 0 : l, slot, step);
        if (flies) {
            take_vector(s, s->position, l, a->position);
            take_vector(s, s->velocity, l, a->velocity);
            take_vector(s, s->goal, l, a->goal);
            agent_steer(a, slot, step);
        }
        for (int i = 0; i < 3; i++) s->command[i * count + l] = flies ? a->command[i] : 0.0;
    }
}

void swarm_move(swarm *s, int step)
{
    const int count = s->local_count;
    const double dt = s->config.slot_s / s->config.steps;
    for (int l = 0; l < count; l++)
        if (s->present[l] && (s->active[l] || s->velocity[l] != 0.0 ||
                              s->velocity[count + l] != 0.0 || s->velocity[2 * count + l] != 0.0))
            vehicle_step(&s->vehicle, dt, s->position + l, s->velocity + l, s->command + l, count);
    memcpy(s->track + (long)step * 3 * count, s->position, sizeof(double) * 3 * (size_t)count);
}

void swarm_fly(swarm *s, int64_t slot)
{
    for (int step = 0; step < s->config.steps; step++) {
        swarm_steer(s, slot, step, 1);
        swarm_move(s, step);
    }
}

void swarm_complete(swarm *s, int64_t slot, int all, const uint8_t *heard)
{
    swarm_fly(s, slot);
    for (int i = 0; i < s->sender_count && (all || heard); i++) {
        const int l = s->senders[i];
        swarm_hear(s, slot, s->frames + (long)l * DTSA_FRAME_MAX, s->frame_length[l],
                   heard ? heard + (long)i * s->table_count : NULL);
    }
    swarm_end(s, slot);
}
