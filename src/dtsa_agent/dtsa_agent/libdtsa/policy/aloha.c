/* ALOHA: each agent in A_p sends with probability 1 / N_p, by a seeded draw that depends on slot
 * and id only. */
#include "policy.h"

static choice aloha_decide(dtsa_agent *a, int64_t slot)
{
    const dtsa_table *t = a->table;
    const choice back = choose_outside(t, slot);
    if (back.index >= 0) return back;
    int members = 0;
    for (int k = 0; k < t->config->agents; k++) members += t->in_ap[k];
    const double draw =
        draw_uniform(t->config->key, (uint64_t)slot * 65536u + (uint64_t)a->self + 1);
    const int sends = t->in_ap[a->self] && draw * members < 1.0;
    return (choice){sends ? a->self : -1, DTSA_REASON_RANDOM, 0.0};
}

const policy_row policy_aloha = {.name = "aloha", .decide = aloha_decide, .end = end_counters};
