/* What a policy is: one row, one file. docs/reference/protocol.md says who sends under each. */
#ifndef DTSA_POLICY_H
#define DTSA_POLICY_H

#include "core.h"

typedef struct choice {
    int index; /* 0-based, -1: nobody */
    int reason;
    double score;
} choice;

struct policy_row {
    const char *name;
    int by_table; /* decides by the table alone: one decision serves all agents with equal tables */
    size_t (*bytes)(const dtsa_config *config); /* of an agent's own state; NULL: it has none */
    void (*begin)(dtsa_agent *agent);           /* state of a new or restarted agent */
    choice (*decide)(dtsa_agent *agent, int64_t slot);
    /* Adds to an own extended frame, heard by nobody yet. */
    void (*speak)(dtsa_agent *agent, int64_t slot, extended_frame *frame);
    /* wakes: the sender was not in A_p and is now. */
    void (*heard)(dtsa_agent *agent, int64_t slot, const extended_frame *frame, int wakes);
    void (*end)(dtsa_agent *agent, int64_t slot);
    void (*status)(const dtsa_agent *agent, dtsa_status *status);
    int needs_extended, says_leaving;
};

extern const policy_row policy_tdma, policy_dtsa, policy_age, policy_aloha, policy_lease,
    policy_innovation;
const policy_row *policy_of(int number); /* NULL: there is none */

/* common.c: what several policies do */
choice choose_nobody(void);
choice choose_outside(const dtsa_table *table, int64_t slot); /* return_every */
/* Fills the counters h; -> number of members of A_p, and of these the one with the largest h (-1:
 * none). */
int count_members(dtsa_table *table, int64_t slot, int *oldest);
void end_counters(dtsa_agent *agent, int64_t slot); /* eq:secondary */

#endif
