/* Tables: what one observer has heard of everybody. Without loss one table can serve all agents,
 * because every agent then hears the same and computes the same. A frame is checked once, then taken
 * in by each table that hears it. */
#include <math.h>
#include <string.h>

#include "policy/policy.h"

static uint64_t bits(double x)
{
    uint64_t u;
    memcpy(&u, &x, sizeof u);
    return u;
}

/* Keeps the digest of a table: the XOR of one hash an entry, so that a change costs one entry. */
static void rehash(dtsa_table *t, int k)
{
    const int n = t->config->agents;
    uint64_t x = mix64((uint64_t)k + 1);
    x = mix64(x ^ (uint64_t)t->sent_slot[k]);
    x = mix64(x ^ (uint64_t)t->last[k]);
    x = mix64(x ^ t->in_ap[k]);
    for (int i = 0; i < 3; i++) {
        x = mix64(x ^ bits(t->sent_p[i * n + k]));
        x = mix64(x ^ bits(t->sent_v[i * n + k]));
    }
    if (t->config->policy == DTSA_POLICY_INNOVATION) x = mix64(x ^ bits(t->innovation[k]));
    const uint32_t hash =
        (uint32_t)(x ^ x >> 32); /* players of bags refuse numbers that a double cannot hold */
    *t->hash ^= t->entry_hash[k] ^ hash;
    t->entry_hash[k] = hash;
}

void table_reset(dtsa_table *t)
{
    const int n = t->config->agents;
    *t->hash = 0;
    for (int k = 0; k < n; k++) {
        for (int i = 0; i < 3; i++) {
            t->sent_p[i * n + k] = t->config->start[i * n + k];
            t->sent_v[i * n + k] = t->sent_c[i * n + k] = 0.0;
        }
        t->innovation[k] = 0.0;
        t->sent_slot[k] = t->last[k] = -1;
        t->in_ap[k] = 1;
        t->entry_hash[k] = 0;
        rehash(t, k);
    }
}

void table_learn(dtsa_table *t, const dtsa_frame *f, int64_t sampled)
{
    const int n = t->config->agents, k = f->sender - 1;
    const int rests = f->c_r == 0; /* out of A_p: it stands at its target, where all know that */
    double innovation = 0.0;
    for (int i = 0; i < 3; i++) {
        const int e = i * n + k;
        const double v = rests ? 0.0 : f->v[i];
        innovation += fabs(v - t->sent_v[e]);
        t->sent_p[e] = rests && t->config->targets_known ? t->config->target[e] : f->p[i];
        t->sent_v[e] = v;
        t->sent_c[e] = rests ? 0.0 : f->c[i];
    }
    t->innovation[k] = innovation;
    t->sent_slot[k] = sampled;
    t->in_ap[k] = !rests;
    if (t->last[k] < sampled) t->last[k] = sampled;
    rehash(t, k);
}

void table_turn(dtsa_table *t, int k, int64_t slot)
{
    if (t->last[k] >= slot) return;
    t->last[k] = slot; /* eq:secondary */
    rehash(t, k);
}

int scratch_doubles(int n)
{
    const int avoid = avoid_scratch_doubles(n), table = 6 * n + priority_scratch_doubles(n);
    return avoid > table ? avoid : table;
}

/* What the air carried. */

static int known(int id, int n) { return id <= n; }

/* Ids that exist, and leases said by the owner of the slot only. */
static int known_ids(int n, const extended_frame *e, int64_t slot)
{
    const int own_turn = slot % n == e->own.sender - 1;
    if (e->c_s >= n || !known(e->far_id, n) || (e->lease_count && !own_turn)) return 0;
    for (int i = 0; i < e->gossip_count; i++)
        if (!known(e->gossip[i].id, n)) return 0;
    for (int i = 0; i < e->lease_count; i++)
        if (!known(e->leases[i], n) && e->leases[i] != LEASE_OPEN) return 0;
    for (int i = 0; i < RELAY_IDS && e->relay_mask; i++)
        if (!known(e->relay_ids[i], n) && e->relay_ids[i] != LEASE_OPEN) return 0;
    return 1;
}

int frame_admit(const dtsa_config *c, int64_t slot, const uint8_t *data, long length,
                heard_frame *heard)
{
    extended_frame *e = &heard->e;
    const int extended = c->profile == DTSA_PROFILE_EXTENDED;
    if (extended) {
        if (extended_decode(data, length, c->position_step, e) != FRAME_OK) return HEARD_MALFORMED;
    } else if (frame_decode(data, length, c->position_step, &e->own) != FRAME_OK ||
               e->own.profile == DTSA_PROFILE_EXTENDED) {
        return HEARD_MALFORMED;
    }
    const int late = e->own.slot != slot_on_air(c, slot);
    heard->sampled = slot - late;
    /* unknown agents, or a frame of another time (a replay) */
    if (late && (slot < 1 || e->own.slot != slot_on_air(c, slot - 1))) return HEARD_FOREIGN;
    if (e->own.sender > c->agents) return HEARD_FOREIGN;
    return !extended || known_ids(c->agents, e, heard->sampled) ? HEARD : HEARD_FOREIGN;
}

int table_take(dtsa_table *t, const heard_frame *heard)
{
    const extended_frame *e = &heard->e;
    const int k = e->own.sender - 1, wakes = !t->in_ap[k] && e->own.c_r;
    if (t->sent_slot[k] < heard->sampled) table_learn(t, &e->own, heard->sampled);
    if (t->config->profile == DTSA_PROFILE_EXTENDED && t->observer != k)
        for (int i = 0; i < e->gossip_count; i++)
            gossip_learn(t, heard->sampled - e->gossip[i].age, &e->gossip[i]);
    return wakes;
}

void agent_take(dtsa_agent *a, const heard_frame *heard)
{
    const int own = heard->e.own.sender - 1 == a->self;
    if (own && a->table->config->profile == DTSA_PROFILE_EXTENDED)
        return; /* it knows what it said */
    const int wakes = table_take(a->table, heard);
    if (a->policy->heard && !own) a->policy->heard(a, heard->sampled, &heard->e, wakes);
}

void agent_said(dtsa_agent *a, int64_t slot, const uint8_t *data, long length)
{
    dtsa_table *t = a->table;
    dtsa_frame f;
    if (t->sent_slot[a->self] == slot) return;
    if (a->decision.reason == DTSA_REASON_LEASE_OPEN) return; /* gossip says whether it was heard */
    if (frame_decode(data, length, t->config->position_step, &f) == FRAME_OK)
        table_learn(t, &f, slot);
}
