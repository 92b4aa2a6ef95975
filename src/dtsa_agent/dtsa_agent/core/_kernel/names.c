/* Names of everything that Python and C both number. core/registry.py and core/flight_models.py compare them with theirs. */
#include <assert.h>

#include "module.h"

#define NAME_COUNT(names) ((int)(sizeof(names) / sizeof *(names)))

static const char *const POLICIES[] = {
    [POLICY_TDMA] = "tdma",   [POLICY_DTSA] = "dtsa",   [POLICY_AGE] = "age",
    [POLICY_ALOHA] = "aloha", [POLICY_LEASE] = "lease",
};
static_assert(NAME_COUNT(POLICIES) == POLICY_EXTERNAL, "a policy without a name");

static const char *const ESTIMATORS[] = {
    [ESTIMATE_HOLD] = "hold",
    [ESTIMATE_LINEAR] = "linear",
    [ESTIMATE_INTENT] = "intent",
    [ESTIMATE_ORACLE] = "oracle",
};
static_assert(NAME_COUNT(ESTIMATORS) == ESTIMATE_EXTERNAL, "an estimator without a name");

static const char *const AVOIDERS[] = {
    [AVOID_ORCA] = "orca",
    [AVOID_POTENTIAL] = "potential",
    [AVOID_BVC] = "bvc",
    [AVOID_NONE] = "none",
};
static_assert(NAME_COUNT(AVOIDERS) == AVOID_KINDS, "an avoider without a name");

static const char *const SELECTIONS[] = {
    [SELECT_CANDIDATES] = "candidates",
    [SELECT_PAIRWISE] = "pairwise",
};
static_assert(NAME_COUNT(SELECTIONS) == SELECT_COUNT, "a selection without a name");

static const char *const PROFILES[] = {
    [PROFILE_PAPER] = "paper",
    [PROFILE_PAPER_INTENT] = "paper-intent",
    [PROFILE_EXTENDED] = "extended",
};
static_assert(NAME_COUNT(PROFILES) == PROFILE_COUNT, "a profile without a name");

static const char *const REASONS[] = {
    [REASON_NOBODY] = "nobody",
    [REASON_TDMA] = "tdma",
    [REASON_BOOT] = "boot",
    [REASON_AGE_CAP] = "age-cap",
    [REASON_PRIORITY] = "priority",
    [REASON_TIE] = "tie",
    [REASON_OLDEST] = "oldest",
    [REASON_RETURN] = "return",
    [REASON_RANDOM] = "random",
    [REASON_PLUGIN] = "plugin",
    [REASON_LEASE_OWN] = "own",
    [REASON_LEASE_ANCHOR] = "anchor",
    [REASON_LEASE_LEASED] = "leased",
    [REASON_LEASE_ADOPTED] = "adopted",
    [REASON_LEASE_OPEN] = "open",
    [REASON_LEASE_ABSENT] = "absent",
    [REASON_LEASE_PROBATION] = "probation",
};
static_assert(NAME_COUNT(REASONS) == REASON_COUNT, "a reason without a name");

#define LIST(kind, names) {kind, names, NAME_COUNT(names)}
static const struct {
    const char *kind;
    const char *const *names;
    int count;
} LISTS[] = {
    LIST("policies", POLICIES),     LIST("estimators", ESTIMATORS), LIST("avoiders", AVOIDERS),
    LIST("selections", SELECTIONS), LIST("profiles", PROFILES),     LIST("reasons", REASONS),
};

PyObject *names_dict(void)
{
    PyObject *dict = PyDict_New();
    for (int i = 0; dict && i < NAME_COUNT(LISTS); i++) {
        PyObject *tuple = PyTuple_New(LISTS[i].count);
        int failed = !tuple;
        for (int k = 0; !failed && k < LISTS[i].count; k++) {
            PyObject *name = PyUnicode_FromString(LISTS[i].names[k]);
            failed = !name;
            if (name) PyTuple_SET_ITEM(tuple, k, name);
        }
        if (failed || PyDict_SetItemString(dict, LISTS[i].kind, tuple) < 0) Py_CLEAR(dict);
        Py_XDECREF(tuple);
    }
    return dict;
}
