/* All policies, by number. */
#include "policy.h"

static choice decide_nothing(dtsa_agent *a, int64_t slot)
{
    (void)a;
    (void)slot;
    return choose_nobody();
}

/* Somebody else fills in what the agent decided. */
static const policy_row policy_external = {
    .name = "external", .decide = decide_nothing, .end = end_counters};

static const policy_row *const POLICIES[] = {
    [DTSA_POLICY_TDMA] = &policy_tdma,         [DTSA_POLICY_DTSA] = &policy_dtsa,
    [DTSA_POLICY_AGE] = &policy_age,           [DTSA_POLICY_ALOHA] = &policy_aloha,
    [DTSA_POLICY_LEASE] = &policy_lease,       [DTSA_POLICY_INNOVATION] = &policy_innovation,
    [DTSA_POLICY_EXTERNAL] = &policy_external,
};

const policy_row *policy_of(int number)
{
    return number >= 0 && number <= DTSA_POLICY_EXTERNAL ? POLICIES[number] : NULL;
}
