/* Tables: what one observer has heard of everybody. Without loss one table can serve all agents,
 * because every agent then hears the same and computes the same. */
#include <math.h>
#include <string.h>

#include "core.h"

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
