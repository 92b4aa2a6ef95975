/* Agents in slots: tables, decisions, frames, flight. One implementation for the nodes, the simulator and the verifier.
 *
 * A slot i, in this order: decide and emit (from what was heard before slot i), fly, hear (what the air carried in
 * slot i), end. A table is what one observer believes about everybody; without loss one table can serve all, because
 * every agent then hears the same and computes the same.
 */
#include <math.h>
#include <string.h>

#include "dtsa.h"
#include "lease.h"

uint64_t mix64(uint64_t x)
{
    x += 0x9e3779b97f4a7c15ULL;
    x = (x ^ x >> 30) * 0xbf58476d1ce4e5b9ULL;
    x = (x ^ x >> 27) * 0x94d049bb133111ebULL;
    return x ^ x >> 31;
}

static uint64_t bits(double x)
{
    uint64_t u;
    memcpy(&u, &x, sizeof u);
    return u;
}

/* Keeps the digest of a table: the XOR of one hash an entry, so that a change costs one entry. */
static void rehash(swarm *s, int table, int k)
{
    const long plane = (long)table * 3 * s->n + k, at = (long)table * s->n + k;
    uint64_t x = mix64((uint64_t)k + 1);
    x = mix64(x ^ (uint64_t)s->sent_slot[at]);
    x = mix64(x ^ (uint64_t)s->last[at]);
    x = mix64(x ^ s->in_ap[at]);
    for (int i = 0; i < 3; i++) {
        x = mix64(x ^ bits(s->sent_p[plane + (long)i * s->n]));
        x = mix64(x ^ bits(s->sent_v[plane + (long)i * s->n]));
    }
    const uint32_t hash =
        (uint32_t)(x ^ x >> 32); /* players of bags refuse numbers that a double cannot hold */
    s->table_hash[table] ^= s->entry_hash[at] ^ hash;
    s->entry_hash[at] = hash;
}

void swarm_reset_table(swarm *s, int table)
{
    const int n = s->n;
    s->table_hash[table] = 0;
    for (int k = 0; k < n; k++) {
        const long plane = (long)table * 3 * n + k, at = (long)table * n + k;
        for (int i = 0; i < 3; i++) {
            s->sent_p[plane + (long)i * n] = s->start[i * n + k];
            s->sent_v[plane + (long)i * n] = s->sent_c[plane + (long)i * n] = 0.0;
        }
        s->sent_slot[at] = s->last[at] = -1;
        s->in_ap[at] = 1;
        s->entry_hash[at] = 0;
        rehash(s, table, k);
    }
}

void swarm_reset_tables(swarm *s)
{
    const int n = s->n;
    for (int table = 0; table < s->table_count; table++) swarm_reset_table(s, table);
    for (int l = 0; l < s->local_count; l++) {
        for (int i = 0; i < 3; i++) {
            const double p = s->start[i * n + s->local[l]];
            s->pos[i * s->local_count + l] = p;
            s->vel[i * s->local_count + l] = s->cmd[i * s->local_count + l] = 0.0;
            s->goal[i * s->local_count + l] = s->target[i * n + s->local[l]];
            for (int step = 0; step < s->steps; step++)
                s->track[(step * 3 + i) * s->local_count + l] = p;
        }
        s->active[l] = s->present[l] = 1;
        s->frame_len[l] = s->sends[l] = 0;
    }
    s->sender_count = 0;
    s->malformed = s->foreign = 0;
    if (s->policy == POLICY_LEASE)
        for (int l = 0; l < s->local_count; l++) lease_restart(s, l);
}

/* ---- estimation (eq:estimate) ---- */

DTSA_SIMD
static void extrapolate(int n, const double *restrict p, const double *restrict v,
                        const double *restrict age, double *restrict out)
{
    for (int k = 0; k < n; k++) out[k] = p[k] + v[k] * age[k];
}

static void estimate_into(const swarm *s, int table, int kind, int64_t slot, int step, double *p,
                          double *v)
{
    const int n = s->n;
    const long plane = (long)table * 3 * n;
    const int64_t *sent = s->sent_slot + (long)table * n;
    double *age = s->ages;
    const double offset = step * s->dt;
    for (int k = 0; k < n; k++)
        age[k] = sent[k] < 0 ? 0.0 : (double)(slot - sent[k]) * s->slot_s + offset;
    if (kind == ESTIMATE_INTENT) {
        for (int k = 0; k < n; k++) {
            const int64_t ago = sent[k] < 0 ? 0 : (slot - sent[k]) * s->steps + step;
            const int at = ago < s->decay_len ? (int)ago : s->decay_len - 1;
            const double q = s->decay[at], w = s->decay[s->decay_len + at];
            for (int i = 0; i < 3; i++) {
                const long e = plane + (long)i * n + k;
                const double c = s->sent_c[e], d = s->sent_v[e] - c;
                p[i * n + k] = s->sent_p[e] + c * age[k] + d * w;
                v[i * n + k] = c + d * q;
            }
        }
        return;
    }
    for (int i = 0; i < 3; i++) {
        const long e = plane + (long)i * n;
        /* hold: position and velocity as last heard. The frame carries the velocity, so the avoider may use it. */
        if (kind == ESTIMATE_HOLD)
            memcpy(p + i * n, s->sent_p + e, sizeof(double) * (size_t)n);
        else
            extrapolate(n, s->sent_p + e, s->sent_v + e, age, p + i * n);
        memcpy(v + i * n, s->sent_v + e, sizeof(double) * (size_t)n);
    }
}

void swarm_estimate(swarm *s, int table, int64_t slot, int step)
{
    double *p = s->est_p + (long)table * 3 * s->n, *v = s->est_v + (long)table * 3 * s->n;
    if (s->estimator == ESTIMATE_EXTERNAL) return;
    if (s->estimator != ESTIMATE_ORACLE) {
        estimate_into(s, table, s->estimator, slot, step, p, v);
        return;
    }
    for (int l = 0; l < s->local_count; l++)
        for (int i = 0; i < 3; i++) {
            p[i * s->n + s->local[l]] = s->pos[i * s->local_count + l];
            v[i * s->n + s->local[l]] = s->vel[i * s->local_count + l];
        }
}

/* ---- decisions ---- */

typedef struct {
    int index; /* 0-based, -1: nobody */
    int reason;
    double score;
} choice;

static choice choose_outside(const swarm *s, int64_t slot, const uint8_t *in_ap)
{
    choice none = {-1, REASON_NOBODY, 0.0};
    if (s->return_every < 1 || slot % s->return_every != s->return_every - 1) return none;
    int outside = 0;
    for (int k = 0; k < s->n; k++) outside += !in_ap[k];
    if (!outside) return none;
    int skip = (int)(slot / s->return_every % outside);
    for (int k = 0; k < s->n; k++)
        if (!in_ap[k] && skip-- == 0) return (choice){k, REASON_RETURN, 0.0};
    return none;
}

/* Whose turn it is in the eyes of one table; the same for every agent whose table is the same. */
static choice choose(swarm *s, int table, int64_t slot)
{
    const int n = s->n;
    const uint8_t *in_ap = s->in_ap + (long)table * n;
    const int64_t *last = s->last + (long)table * n;
    int64_t *h = s->h + (long)table * n;
    if (s->policy == POLICY_TDMA) return (choice){(int)(slot % n), REASON_TDMA, 0.0};
    if (s->policy == POLICY_DTSA && s->boot_round && slot < n)
        return (choice){(int)slot, REASON_BOOT, 0.0};
    const choice back = choose_outside(s, slot, in_ap);
    if (back.index >= 0) return back;

    int members = 0, oldest = -1;
    for (int k = 0; k < n; k++) {
        h[k] = slot - 1 - last[k];
        members += in_ap[k];
        if (in_ap[k] && (oldest < 0 || h[k] > h[oldest])) oldest = k;
    }
    if (!members) return (choice){-1, REASON_NOBODY, 0.0};
    if (s->policy == POLICY_AGE) return (choice){oldest, REASON_OLDEST, 0.0};
    if (s->age_cap > 0.0 && (double)h[oldest] >= s->age_cap * members)
        return (choice){oldest, REASON_AGE_CAP, 0.0};

    double *p = s->scratch, *v = p + 3 * n, *g = s->g + (long)table * n;
    const int kind = s->estimator == ESTIMATE_INTENT ? ESTIMATE_INTENT : ESTIMATE_LINEAR;
    estimate_into(s, table, kind, slot, 0, p, v);
    priority_values(n, s->slot_s, p, v, g, v + 3 * n);
    choice c;
    c.index = select_sender(n, s->selection, s->epsilon, g, h, in_ap, 0, &c.reason);
    c.score = c.index < 0 ? 0.0 : g[c.index];
    return c;
}

/* ALOHA: each agent in A_p sends with probability 1 / N_p, by a seeded draw that depends on slot and id only. */
static choice choose_aloha(const swarm *s, int table, int64_t slot, int self)
{
    const uint8_t *in_ap = s->in_ap + (long)table * s->n;
    const choice back = choose_outside(s, slot, in_ap);
    if (back.index >= 0) return back;
    int members = 0;
    for (int k = 0; k < s->n; k++) members += in_ap[k];
    const uint64_t draw = mix64(s->key ^ mix64((uint64_t)slot * 65536u + (uint64_t)self + 1)) >> 11;
    if (in_ap[self] && (double)draw * 0x1p-53 * members < 1.0)
        return (choice){self, REASON_RANDOM, 0.0};
    return (choice){-1, REASON_RANDOM, 0.0};
}

static int table_of(const swarm *s, int l) { return s->shared ? 0 : l; }

void swarm_decide(swarm *s, int64_t slot)
{
    choice c = {-1, REASON_NOBODY, 0.0};
    for (int l = 0; l < s->local_count; l++) {
        const int table = table_of(s, l), self = s->local[l];
        if (s->policy == POLICY_LEASE) {
            c.index = lease_decide(s, l, slot, &c.reason);
        } else if (s->policy == POLICY_ALOHA) {
            c = choose_aloha(s, table, slot, self);
        } else if (l == 0 || !s->shared) {
            c = choose(s, table, slot);
        }
        s->chosen[l] = (uint16_t)(c.index + 1);
        s->reason[l] = (uint8_t)c.reason;
        s->score[l] = c.score;
        s->digest[l] = s->table_hash[table];
        s->sends[l] = c.index == self && s->present[l];
    }
}

int swarm_far_from_goal(const swarm *s, int l)
{
    double e2 = 0.0;
    for (int i = 0; i < 3; i++) {
        const double d = s->goal[i * s->local_count + l] - s->pos[i * s->local_count + l];
        e2 += d * d;
    }
    return sqrt(e2) > s->r_min; /* eq:remaining_t_slots */
}

void swarm_emit(swarm *s, int64_t slot)
{
    s->sender_count = 0;
    for (int l = 0; l < s->local_count; l++) {
        s->frame_len[l] = 0;
        if (!s->sends[l]) continue;
        dtsa_frame *f = &s->own[l];
        f->profile = s->profile;
        f->sender = s->local[l] + 1;
        f->slot = (uint32_t)slot;
        f->c_r = swarm_far_from_goal(s, l) ? s->c_r : 0;
        for (int i = 0; i < 3; i++) {
            f->p[i] = s->pos[i * s->local_count + l];
            f->v[i] = s->vel[i * s->local_count + l];
            f->c[i] = s->cmd[i * s->local_count + l];
        }
        uint8_t *out = s->frames + (long)l * FRAME_MAX;
        s->frame_len[l] =
            (uint8_t)(s->profile == PROFILE_EXTENDED ? extended_emit(s, l, slot, f, out)
                                                     : frame_encode(f, s->position_step, out));
        if (s->frame_len[l]) s->senders[s->sender_count++] = l;
    }
}

/* ---- what the air carried ---- */

/* One observer learns one agent's sent state. */
void swarm_learn(swarm *s, int table, const dtsa_frame *f, int64_t sampled)
{
    const int n = s->n, k = f->sender - 1;
    const long at = (long)table * n + k, plane = (long)table * 3 * n + k;
    const int rests = f->c_r == 0; /* out of A_p: it stands at its target, where all know that */
    for (int i = 0; i < 3; i++) {
        const long e = plane + (long)i * n;
        s->sent_p[e] = rests && s->targets_known ? s->target[i * n + k] : f->p[i];
        s->sent_v[e] = rests ? 0.0 : f->v[i];
        s->sent_c[e] = rests ? 0.0 : f->c[i];
    }
    s->sent_slot[at] = sampled;
    s->in_ap[at] = !rests;
    if (s->last[at] < sampled) s->last[at] = sampled;
    rehash(s, table, k);
}

int swarm_hear(swarm *s, int64_t slot, const uint8_t *data, long length, const uint8_t *mask)
{
    if (s->profile == PROFILE_EXTENDED) return extended_hear(s, slot, data, length, mask);
    dtsa_frame f;
    if (frame_decode(data, length, s->position_step, &f) != FRAME_OK ||
        f.profile == PROFILE_EXTENDED) {
        s->malformed++;
        return 0;
    }
    const uint32_t late = (uint32_t)slot - f.slot;
    if (f.sender > s->n || late > 1) { /* an unknown agent, or a frame of another time (a replay) */
        s->foreign++;
        return 0;
    }
    for (int table = 0; table < s->table_count; table++) {
        if (mask && !mask[table]) continue;
        if (s->sent_slot[(long)table * s->n + f.sender - 1] >= slot - late) continue;
        swarm_learn(s, table, &f, slot - late);
    }
    return 1;
}

void swarm_end(swarm *s, int64_t slot)
{
    /* A sender knows what it said, whether or not anybody heard it: its own entry is the last SENT state. */
    for (int i = 0; i < s->sender_count; i++) {
        const int l = s->senders[i], table = table_of(s, l);
        dtsa_frame f;
        if (s->sent_slot[(long)table * s->n + s->local[l]] == slot) continue;
        if (frame_decode(s->frames + (long)l * FRAME_MAX, s->frame_len[l], s->position_step, &f) ==
            FRAME_OK)
            swarm_learn(s, table, &f, slot);
    }
    if (s->policy == POLICY_LEASE) {
        lease_end(s, slot);
        return;
    }
    const int tables = s->shared ? (s->local_count > 0) : s->local_count;
    for (int l = 0; l < tables; l++) {
        const int k = (int)s->chosen[l] - 1;
        if (k < 0) continue;
        const long at = (long)l * s->n + k;
        if (s->last[at] < slot) {
            s->last[at] = slot; /* eq:secondary */
            rehash(s, l, k);
        }
    }
}

/* ---- flight ---- */

void swarm_steer(swarm *s, int64_t slot, int step, int estimate)
{
    const int n = s->n, count = s->local_count;
    const int aged = s->avoid.margin_rate > 0.0;
    for (int l = 0; l < count; l++) {
        const int table = table_of(s, l);
        double *c = s->cmd + l;
        if (!s->active[l] || !s->present[l]) {
            c[0] = c[count] = c[2 * count] = 0.0;
            if (!(l == 0 && s->shared)) continue;
        }
        const double *p = s->est_p + (long)table * 3 * n, *v = s->est_v + (long)table * 3 * n;
        if (estimate && (l == 0 || !s->shared)) swarm_estimate(s, table, slot, step);
        if (!s->active[l] || !s->present[l]) continue;
        if (aged) {
            const int64_t *sent = s->sent_slot + (long)table * n;
            for (int k = 0; k < n; k++)
                s->ages[k] =
                    sent[k] < 0 ? 0.0 : (double)(slot - sent[k]) * s->slot_s + step * s->dt;
        }
        const double position[3] = {s->pos[l], s->pos[count + l], s->pos[2 * count + l]};
        const double velocity[3] = {s->vel[l], s->vel[count + l], s->vel[2 * count + l]};
        const double goal[3] = {s->goal[l], s->goal[count + l], s->goal[2 * count + l]};
        double command[3];
        avoid_command(s->avoider, &s->avoid, n, s->local[l], position, velocity, goal, p, v,
                      aged ? s->ages : 0, s->scratch, command);
        c[0] = command[0];
        c[count] = command[1];
        c[2 * count] = command[2];
    }
}

void swarm_move(swarm *s, int step)
{
    const int count = s->local_count;
    for (int l = 0; l < count; l++)
        if (s->present[l] && (s->active[l] || s->vel[l] != 0.0 || s->vel[count + l] != 0.0 ||
                              s->vel[2 * count + l] != 0.0))
            vehicle_step(&s->vehicle, s->dt, s->pos + l, s->vel + l, s->cmd + l, count);
    memcpy(s->track + (long)step * 3 * count, s->pos, sizeof(double) * 3 * (size_t)count);
}

void swarm_fly(swarm *s, int64_t slot)
{
    for (int step = 0; step < s->steps; step++) {
        swarm_steer(s, slot, step, 1);
        swarm_move(s, step);
    }
}
