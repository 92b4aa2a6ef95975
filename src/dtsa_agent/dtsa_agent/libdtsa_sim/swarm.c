/* Agents in slots, many at once: the same agents that libdtsa makes one of, on arrays of a caller.
 *
 * A slot i, in this order: decide and emit (from what was heard before slot i), fly, hear (what the
 * air carried in slot i), end. Without loss one table can serve all, because every agent then hears
 * the same and computes the same.
 */
#include "swarm.h"

#include <math.h>
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
    const size_t n = (size_t)s->config.agents, l = (size_t)s->local_count;
    s->config.target = s->known_goal;
    const char *fault = check(s);
    if (fault) return fault;
    const size_t bytes = swarm_policy_bytes(&s->config);
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

/* ---- goals ---- */

/* Only the own state of each agent is looked at. */
void swarm_advance(swarm *s, course *c, int64_t slot)
{
    const int n = s->config.agents, count = s->local_count;
    const double *last = c->goals + (long)(c->goal_count - 1) * 3 * n;
    if (course_advance(c, slot, s->position) || slot == 0) {
        memcpy(s->goal, c->goal, sizeof(double) * 3 * (size_t)count);
        for (int l = 0; l < count; l++) s->final[l] = (uint8_t)course_is_final(c, l);
    }
    /* An agent that waits for its first slot stands at its start, and all know that. */
    for (int e = 0; e < 3 * n && s->goals_known; e++)
        s->known_goal[e] = (c->begin[e % n] <= slot ? last : c->start)[e];
    for (int l = 0; l < count; l++) {
        const int64_t said = s->sent_slot[(s->shared ? 0 : (long)l * n) + s->local[l]];
        const int waits = s->announce && said >= 0 && said < c->changed[l];
        s->active[l] = c->moving[s->local[l]] && c->leg[l] >= 0 && !waits;
    }
}

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

void swarm_fly(swarm *s, int64_t slot, int estimated)
{
    for (int step = 0; step < s->config.steps; step++) {
        swarm_steer(s, slot, step, step > 0 || !estimated);
        swarm_move(s, step);
    }
}

void swarm_complete(swarm *s, int64_t slot, int estimated, int all, const uint8_t *heard)
{
    swarm_fly(s, slot, estimated);
    for (int i = 0; i < s->sender_count && (all || heard); i++) {
        const int l = s->senders[i];
        swarm_hear(s, slot, s->frames + (long)l * DTSA_FRAME_MAX, s->frame_length[l],
                   heard ? heard + (long)i * s->table_count : NULL);
    }
    swarm_end(s, slot);
}

/* ---- its only local agent behind a station ---- */

static swarm *piloted(void *context) { return ((swarm_pilot *)context)->swarm; }

static int pilot_open(void *context, int64_t slot, int hovers, uint8_t frame[DTSA_DATAGRAM_MAX],
                      int *chosen)
{
    const swarm_pilot *pilot = context;
    swarm *s = pilot->swarm;
    if (pilot->prepare)
        pilot->prepare(pilot->context, slot, hovers);
    else
        s->active[0] = pilot->moves && !hovers;
    const int sends = swarm_begin(s, slot);
    *chosen = s->chosen[0];
    if (!sends) return 0;
    memcpy(frame, s->frames, s->frame_length[0]);
    return s->frame_length[0];
}

static int pilot_hear(void *context, int64_t slot, const uint8_t *frame, long length)
{
    return swarm_hear(piloted(context), slot, frame, length, NULL);
}

static void pilot_unsent(void *context) { piloted(context)->frame_length[0] = 0; }
static void pilot_close(void *context, int64_t slot) { swarm_end(piloted(context), slot); }
static void pilot_restart(void *context) { swarm_restart(piloted(context), 0); }

static int pilot_leave(void *context)
{
    swarm *s = piloted(context);
    const int says = policy_of(s->config.policy)->says_leaving;
    s->present[0] = says ? PRESENT_LEAVING : 0;
    return says;
}

static int pilot_on_probation(void *context)
{
    return dtsa_agent_status(piloted(context)->agents).probation;
}

dtsa_station_agent swarm_station_agent(swarm_pilot *pilot)
{
    return (dtsa_station_agent){pilot,       pilot_open,    pilot_hear,  pilot_unsent,
                                pilot_close, pilot_restart, pilot_leave, pilot_on_probation};
}

/* ---- learning ---- */

static void observe(const swarm *s, int l, int64_t slot, float *out)
{
    const dtsa_table *t = &s->tables[l];
    const int n = s->config.agents, self = s->local[l];
    float *planes = out + SWARM_OBSERVED_OWN;
    double position[3], velocity[3], goal[3], away2 = 0.0;
    int frame = 0;
    take_vector(s, s->position, l, position);
    take_vector(s, s->velocity, l, velocity);
    take_vector(s, s->goal, l, goal);
    for (int j = 0; j < n; j++) {
        const int k = (self + j) % n;
        const int64_t sent = t->sent_slot[k], ago = sent < 0 ? 0 : slot - sent;
        const double since = (double)ago * s->config.slot_s;
        frame |= slot > 0 && sent == slot - 1;
        planes[j] = (float)(ago - 1);
        planes[n + j] = (float)(slot - 1 - t->last[k]);
        planes[2 * n + j] = (float)t->in_ap[k];
        for (int i = 0; i < 3; i++) {
            const double p = t->sent_p[i * n + k], v = t->sent_v[i * n + k];
            planes[(3 + i) * n + j] = (float)(p + v * since - position[i]);
            planes[(6 + i) * n + j] = (float)(v - velocity[i]);
        }
    }
    for (int i = 0; i < 3; i++) {
        const double way = goal[i] - position[i];
        away2 += way * way;
        out[4 + i] = (float)way;
        out[7 + i] = (float)velocity[i];
    }
    out[0] = (float)slot;
    out[1] = (float)((self + n - slot % n) % n);
    out[2] = (float)frame;
    out[3] = (float)(sqrt(away2) > s->config.r_min);
}

void swarm_observe(const swarm *s, int64_t slot, int first, int end, float *out)
{
    const long size = SWARM_OBSERVED_OWN + SWARM_OBSERVED_PLANES * (long)s->config.agents;
    for (int l = first; l < end; l++) observe(s, l, slot, out + (l - first) * size);
}
