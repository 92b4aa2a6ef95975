/* Gossip: frames of profile extended carry what their sender last heard of others. */
#include <string.h>

#include "core.h"

/* What a table holds of an agent, and whether gossip can say it. */
static int sayable(const dtsa_table *t, int k)
{
    const int n = t->config->agents;
    double p[3], v[3];
    for (int i = 0; i < 3; i++) {
        p[i] = t->sent_p[i * n + k];
        v[i] = t->sent_v[i * n + k];
    }
    return gossip_fits(p, v, t->config->position_step);
}

/* The newest state of somebody not yet chosen that is `age` slots old or older and can be said; -1:
 * none. */
static int newest_of_age(const dtsa_table *t, int self, int64_t slot, int age, const int *chosen,
                         int count)
{
    const int64_t *sent = t->sent_slot;
    int best = -1;
    for (int k = 0; k < t->config->agents; k++) {
        const int64_t old = slot - sent[k];
        if (k == self || sent[k] < 0 || old < age || old > GOSSIP_AGE_MAX) continue;
        int taken = 0;
        for (int i = 0; i < count; i++) taken |= chosen[i] == k;
        if (!taken && (best < 0 || sent[k] > sent[best]) && sayable(t, k)) best = k;
    }
    return best;
}

/* Every state is said again three times: at once, which mends single losses soonest, and at two
 * later times, which bring it to those who were deaf for a while. */
int gossip_collect(const dtsa_table *t, int self, int64_t slot, int room, gossip_entry *out)
{
    const int n = t->config->agents;
    const int later = 2 + n / 16, ages[2 * SECTIONS] = {1, later, 2 * later, 1, 1, 1};
    int best[SECTIONS], count = 0;
    for (int i = 0; i < 2 * SECTIONS && count < room; i++) {
        const int k = newest_of_age(t, self, slot, ages[i], best, count);
        if (k >= 0) best[count++] = k;
    }
    for (int i = 0; i < count; i++) {
        const int k = best[i];
        out[i].id = k + 1;
        out[i].age = (int)(slot - t->sent_slot[k]);
        out[i].c_r = t->in_ap[k];
        for (int axis = 0; axis < 3; axis++) {
            out[i].p[axis] = t->sent_p[axis * n + k];
            out[i].v[axis] = t->sent_v[axis * n + k];
        }
    }
    return count;
}

/* A state that somebody else heard replaces an older one only; one at the codec's limit may be a
 * wrong one. */
void gossip_learn(dtsa_table *t, int64_t sampled, const gossip_entry *g)
{
    if (t->observer != g->id - 1) gossip_confirm(t, sampled, g);
}

void gossip_confirm(dtsa_table *t, int64_t sampled, const gossip_entry *g)
{
    if (sampled < 0) return;
    if (t->sent_slot[g->id - 1] >= sampled || !gossip_fits(g->p, g->v, t->config->position_step))
        return;
    dtsa_frame f = {.sender = g->id, .c_r = g->c_r};
    for (int i = 0; i < 3; i++) {
        f.p[i] = g->p[i];
        f.v[i] = f.c[i] = g->v[i];
    }
    table_learn(t, &f, sampled);
}
