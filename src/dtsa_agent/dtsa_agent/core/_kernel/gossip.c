/* Gossip: frames of profile extended carry what their sender last heard of others. */
#include <string.h>

#include "dtsa.h"
#include "lease.h"

/* What a table holds of an agent, and whether gossip can say it. */
static int sayable(const swarm *s, int table, int k)
{
    const long plane = (long)table * 3 * s->n + k;
    double p[3], v[3];
    for (int i = 0; i < 3; i++) {
        p[i] = s->sent_p[plane + (long)i * s->n];
        v[i] = s->sent_v[plane + (long)i * s->n];
    }
    return gossip_fits(p, v, s->position_step);
}

/* The newest state of somebody not yet chosen that is `age` slots old or older and can be said; -1: none. */
static int newest_of_age(const swarm *s, int table, int self, int64_t slot, int age,
                         const int *chosen, int count)
{
    const int64_t *sent = s->sent_slot + (long)table * s->n;
    int best = -1;
    for (int k = 0; k < s->n; k++) {
        const int64_t old = slot - sent[k];
        if (k == self || sent[k] < 0 || old < age || old > GOSSIP_AGE_MAX) continue;
        int taken = 0;
        for (int i = 0; i < count; i++) taken |= chosen[i] == k;
        if (!taken && (best < 0 || sent[k] > sent[best]) && sayable(s, table, k)) best = k;
    }
    return best;
}

/* Every state is said again three times: at once, which mends single losses soonest, and at two later times, which bring it
 * to those who were deaf for a while. */
int gossip_collect(const swarm *s, int table, int self, int64_t slot, int room, gossip_entry *out)
{
    const int64_t *sent = s->sent_slot + (long)table * s->n;
    const int later = 2 + s->n / 16, ages[2 * SECTIONS] = {1, later, 2 * later, 1, 1, 1};
    int best[SECTIONS], count = 0;
    for (int i = 0; i < 2 * SECTIONS && count < room; i++) {
        const int k = newest_of_age(s, table, self, slot, ages[i], best, count);
        if (k >= 0) best[count++] = k;
    }
    for (int i = 0; i < count; i++) {
        const int k = best[i];
        const long plane = (long)table * 3 * s->n + k;
        out[i].id = k + 1;
        out[i].age = (int)(slot - sent[k]);
        out[i].c_r = s->in_ap[(long)table * s->n + k];
        for (int axis = 0; axis < 3; axis++) {
            out[i].p[axis] = s->sent_p[plane + (long)axis * s->n];
            out[i].v[axis] = s->sent_v[plane + (long)axis * s->n];
        }
    }
    return count;
}

/* A state that somebody else heard replaces an older one only; one at the codec's limit may be a wrong one. */
static void learn_gossip(swarm *s, int table, int64_t sampled, const gossip_entry *g)
{
    if (sampled < 0 || s->observer[table] == g->id - 1) return;
    if (s->sent_slot[(long)table * s->n + g->id - 1] >= sampled ||
        !gossip_fits(g->p, g->v, s->position_step))
        return;
    dtsa_frame f = {.sender = g->id, .c_r = g->c_r};
    for (int i = 0; i < 3; i++) {
        f.p[i] = g->p[i];
        f.v[i] = f.c[i] = g->v[i];
    }
    swarm_learn(s, table, &f, sampled);
}

static int known_ids(const swarm *s, const extended_frame *e, int64_t slot)
{
    const int turn = slot % s->n == e->own.sender - 1;
    if (e->own.sender > s->n || e->c_s >= s->n || (e->lease_count && !turn)) return 0;
    for (int i = 0; i < e->gossip_count; i++)
        if (e->gossip[i].id > s->n) return 0;
    for (int i = 0; i < e->lease_count; i++)
        if (e->leases[i] > s->n && e->leases[i] != LEASE_OPEN) return 0;
    for (int i = 0; i < RELAY_IDS && e->relay_mask; i++)
        if (e->relay_ids[i] > s->n && e->relay_ids[i] != LEASE_OPEN) return 0;
    return 1;
}

int extended_emit(swarm *s, int l, int64_t slot, const dtsa_frame *own, uint8_t *out)
{
    extended_frame e = {.own = *own};
    if (s->policy == POLICY_LEASE) lease_fill(s, l, slot, &e);
    const int used = (e.lease_count + SECTION_BYTES - 1) / SECTION_BYTES + (e.relay_mask != 0);
    if (s->gossip)
        e.gossip_count =
            gossip_collect(s, s->shared ? 0 : l, s->local[l], slot, SECTIONS - used, e.gossip);
    return extended_encode(&e, s->position_step, out);
}

int extended_hear(swarm *s, int64_t slot, const uint8_t *data, long length, const uint8_t *mask)
{
    extended_frame e;
    if (extended_decode(data, length, s->position_step, &e) != FRAME_OK) {
        s->malformed++;
        return 0;
    }
    const uint32_t late = (uint32_t)slot - e.own.slot;
    const int64_t sampled = slot - late;
    if (late > 1 ||
        !known_ids(s, &e, sampled)) { /* unknown agents, or a frame of another time (a replay) */
        s->foreign++;
        return 0;
    }
    for (int table = 0; table < s->table_count; table++) {
        const int speaks = s->observer[table] == e.own.sender - 1;
        if (speaks ? s->local_count > 0 : mask && !mask[table])
            continue; /* a local sender knows what it said */
        if (table < s->local_count && !s->shared && !s->present[table]) continue;
        const long at = (long)table * s->n + e.own.sender - 1;
        const int wakes = !s->in_ap[at] && e.own.c_r;
        if (s->sent_slot[at] < sampled) swarm_learn(s, table, &e.own, sampled);
        if (speaks) continue;
        for (int i = 0; i < e.gossip_count; i++)
            learn_gossip(s, table, sampled - e.gossip[i].age, &e.gossip[i]);
        if (s->policy == POLICY_LEASE && table < s->local_count)
            lease_listen(s, table, sampled, &e, wakes);
    }
    return 1;
}
