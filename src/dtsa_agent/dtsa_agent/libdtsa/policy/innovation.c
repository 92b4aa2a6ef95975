/* Innovation: of A_p the one with the largest counter h, weighed by how much its velocity has
 * changed in its last state. Others extrapolate a velocity that it may not keep. */
#include "policy.h"

static const double STRAIGHT = 0.02; /* m/s, weight of an agent that flies straight on */

static choice innovation_decide(dtsa_agent *a, int64_t slot)
{
    const dtsa_table *t = a->table;
    int oldest, best = -1;
    double most = -1.0;
    const choice back = choose_outside(t, slot);
    if (back.index >= 0) return back;
    const int members = count_members(a->table, slot, &oldest);
    if (!members) return choose_nobody();
    if (t->config->age_cap > 0.0 && (double)t->h[oldest] >= t->config->age_cap * members)
        return (choice){oldest, DTSA_REASON_AGE_CAP, 0.0};
    for (int k = 0; k < t->config->agents; k++) {
        const double value = (double)t->h[k] * (STRAIGHT + t->innovation[k]);
        if (!t->in_ap[k] || value <= most) continue;
        best = k;
        most = value;
    }
    return (choice){best, DTSA_REASON_INNOVATION, 0.0};
}

const policy_row policy_innovation = {
    .name = "innovation", .by_table = 1, .decide = innovation_decide, .end = end_counters};
