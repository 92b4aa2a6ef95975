/* Names of everything that has a number. Python's registry compares them with its own. */
#include <assert.h>

#include "dtsa.h"

#define NAME_COUNT(names) ((int)(sizeof(names) / sizeof *(names)))

static const char *const POLICIES[] = {
    [DTSA_POLICY_TDMA] = "tdma",   [DTSA_POLICY_DTSA] = "dtsa",
    [DTSA_POLICY_AGE] = "age",     [DTSA_POLICY_ALOHA] = "aloha",
    [DTSA_POLICY_LEASE] = "lease", [DTSA_POLICY_INNOVATION] = "innovation",
};
static_assert(NAME_COUNT(POLICIES) == DTSA_POLICY_EXTERNAL, "a policy without a name");

static const char *const ESTIMATORS[] = {
    [DTSA_ESTIMATE_HOLD] = "hold",
    [DTSA_ESTIMATE_LINEAR] = "linear",
    [DTSA_ESTIMATE_INTENT] = "intent",
    [DTSA_ESTIMATE_ORACLE] = "oracle",
};
static_assert(NAME_COUNT(ESTIMATORS) == DTSA_ESTIMATE_EXTERNAL, "an estimator without a name");

static const char *const AVOIDERS[] = {
    [DTSA_AVOID_ORCA] = "orca",
    [DTSA_AVOID_POTENTIAL] = "potential",
    [DTSA_AVOID_BVC] = "bvc",
    [DTSA_AVOID_NONE] = "none",
};
static_assert(NAME_COUNT(AVOIDERS) == DTSA_AVOID_COUNT, "an avoider without a name");

static const char *const SELECTIONS[] = {
    [DTSA_SELECT_CANDIDATES] = "candidates",
    [DTSA_SELECT_PAIRWISE] = "pairwise",
};
static_assert(NAME_COUNT(SELECTIONS) == DTSA_SELECT_COUNT, "a selection without a name");

static const char *const PROFILES[] = {
    [DTSA_PROFILE_PAPER] = "paper",
    [DTSA_PROFILE_PAPER_INTENT] = "paper-intent",
    [DTSA_PROFILE_EXTENDED] = "extended",
};
static_assert(NAME_COUNT(PROFILES) == DTSA_PROFILE_COUNT, "a profile without a name");

static const char *const REASONS[] = {
    [DTSA_REASON_NOBODY] = "nobody",
    [DTSA_REASON_TDMA] = "tdma",
    [DTSA_REASON_BOOT] = "boot",
    [DTSA_REASON_AGE_CAP] = "age-cap",
    [DTSA_REASON_PRIORITY] = "priority",
    [DTSA_REASON_TIE] = "tie",
    [DTSA_REASON_OLDEST] = "oldest",
    [DTSA_REASON_RETURN] = "return",
    [DTSA_REASON_RANDOM] = "random",
    [DTSA_REASON_PLUGIN] = "plugin",
    [DTSA_REASON_LEASE_OWN] = "own",
    [DTSA_REASON_LEASE_ANCHOR] = "anchor",
    [DTSA_REASON_LEASE_LEASED] = "leased",
    [DTSA_REASON_LEASE_ADOPTED] = "adopted",
    [DTSA_REASON_LEASE_OPEN] = "open",
    [DTSA_REASON_LEASE_ABSENT] = "absent",
    [DTSA_REASON_LEASE_PROBATION] = "probation",
    [DTSA_REASON_INNOVATION] = "innovation",
};
static_assert(NAME_COUNT(REASONS) == DTSA_REASON_COUNT, "a reason without a name");

#define LIST(kind, names) {kind, names, NAME_COUNT(names)}
static const dtsa_name_list LISTS[] = {
    LIST("policies", POLICIES),     LIST("estimators", ESTIMATORS), LIST("avoiders", AVOIDERS),
    LIST("selections", SELECTIONS), LIST("profiles", PROFILES),     LIST("reasons", REASONS),
};

const dtsa_name_list *dtsa_names(int list)
{
    return list >= 0 && list < NAME_COUNT(LISTS) ? &LISTS[list] : NULL;
}
