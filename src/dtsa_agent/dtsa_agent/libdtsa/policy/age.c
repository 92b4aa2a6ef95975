/* Age: the member of A_p with the largest counter h. */
#include "policy.h"

static choice age_decide(dtsa_agent *a, int64_t slot)
{
    int oldest;
    const choice back = choose_outside(a->table, slot);
    if (back.index >= 0) return back;
    if (!count_members(a->table, slot, &oldest)) return choose_nobody();
    return (choice){oldest, DTSA_REASON_OLDEST, 0.0};
}

const policy_row policy_age = {
    .name = "age", .by_table = 1, .decide = age_decide, .end = end_counters};
