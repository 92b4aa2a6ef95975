/* DTSA, the paper's policy: the member of A_p whose state is most urgent. */
#include "policy.h"

/* Priorities over the states of all agents, extrapolated to this slot (eq:pfs, eq:secondary). */
static choice choose_urgent(dtsa_table *t, int64_t slot)
{
    const dtsa_config *c = t->config;
    const int n = c->agents;
    const int kind =
        c->estimator == DTSA_ESTIMATE_INTENT ? DTSA_ESTIMATE_INTENT : DTSA_ESTIMATE_LINEAR;
    double *p = t->scratch, *v = p + 3 * n;
    choice made = choose_nobody();
    estimate_into(t, kind, slot, 0, p, v);
    made.index = select_urgent(c, p, v, t->h, t->in_ap, t->g, v + 3 * n, &made.reason);
    if (made.index >= 0) made.score = t->g[made.index];
    return made;
}

static choice dtsa_decide(dtsa_agent *a, int64_t slot)
{
    const dtsa_config *c = a->table->config;
    if (c->boot_round && slot < c->agents) return (choice){(int)slot, DTSA_REASON_BOOT, 0.0};
    const choice back = choose_outside(a->table, slot);
    if (back.index >= 0) return back;
    int oldest;
    const int members = count_members(a->table, slot, &oldest);
    if (!members) return choose_nobody();
    if (c->age_cap > 0.0 && (double)a->table->h[oldest] >= c->age_cap * members)
        return (choice){oldest, DTSA_REASON_AGE_CAP, 0.0};
    return choose_urgent(a->table, slot);
}

const policy_row policy_dtsa = {
    .name = "dtsa", .by_table = 1, .decide = dtsa_decide, .end = end_counters};
