/* What several policies do. */
#include "policy.h"

choice choose_nobody(void) { return (choice){-1, DTSA_REASON_NOBODY, 0.0}; }

choice choose_outside(const dtsa_table *t, int64_t slot)
{
    const int n = t->config->agents, every = t->config->return_every;
    if (every < 1 || slot % every != every - 1) return choose_nobody();
    int outside = 0;
    for (int k = 0; k < n; k++) outside += !t->in_ap[k];
    if (!outside) return choose_nobody();
    int skip = (int)(slot / every % outside);
    for (int k = 0; k < n; k++)
        if (!t->in_ap[k] && skip-- == 0) return (choice){k, DTSA_REASON_RETURN, 0.0};
    return choose_nobody();
}

int count_members(dtsa_table *t, int64_t slot, int *oldest)
{
    int members = 0;
    *oldest = -1;
    for (int k = 0; k < t->config->agents; k++) {
        t->h[k] = slot - 1 - t->last[k];
        members += t->in_ap[k];
        if (t->in_ap[k] && (*oldest < 0 || t->h[k] > t->h[*oldest])) *oldest = k;
    }
    return members;
}

void end_counters(dtsa_agent *a, int64_t slot)
{
    if (a->decision.chosen) table_turn(a->table, a->decision.chosen - 1, slot);
}
