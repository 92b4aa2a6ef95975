/* TDMA: slot modulo N. */
#include "policy.h"

static choice tdma_decide(dtsa_agent *a, int64_t slot)
{
    return (choice){(int)(slot % a->table->config->agents), DTSA_REASON_TDMA, 0.0};
}

const policy_row policy_tdma = {
    .name = "tdma", .by_table = 1, .decide = tdma_decide, .end = end_counters};
