/* Inside libdtsa, and for the layer above it that holds many agents: tables, agents, and what
 * policies are made of. */
#ifndef DTSA_CORE_H
#define DTSA_CORE_H

#include "rounding.h"

#include "dtsa.h"
#include "frame.h"

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
/* Elementwise loops give the same bits at any vector width. */
#define DTSA_SIMD __attribute__((target_clones("avx2", "default")))
#else
#define DTSA_SIMD
#endif

/* ---- a table: what one observer knows of everybody ---- */

typedef struct dtsa_table {
    const dtsa_config *config;
    int observer; /* 0-based agent whose table it is, -1: one that hears everything */
    double *sent_p, *sent_v, *sent_c; /* (3, n) last heard state */
    double *innovation; /* (n) change of velocity in that state, against the one before: m/s, sum
                           over the axes */
    int64_t *sent_slot; /* (n), -1: never */
    int64_t
        *last; /* (n) slot in which it last took the agent for the sender; h = slot - 1 - last */
    uint8_t *in_ap;         /* (n) A_p */
    uint32_t *entry_hash;   /* (n) */
    uint32_t *hash;         /* digest: the XOR of the entries' */
    double *est_p, *est_v;  /* (3, n) states extrapolated to some instant */
    double *g;              /* (n) priorities; NaN: the choice did not depend on it */
    int64_t *h;             /* (n) counters */
    double *scratch, *ages; /* scratch_doubles(n), (n): contents undefined between calls */
} dtsa_table;

/* table.c */
void table_reset(dtsa_table *table); /* knows nothing but the settings */
void table_learn(dtsa_table *table, const dtsa_frame *frame, int64_t sampled);
void table_turn(dtsa_table *table, int k, int64_t slot); /* it took k for the slot's sender */
int scratch_doubles(int n);

/* estimate.c (eq:estimate) */
void estimate_into(const dtsa_table *table, int kind, int64_t slot, int step, double *p, double *v);
/* Fills est_p and est_v by the configured estimator, unless that is somebody else's. */
void table_estimate(dtsa_table *table, int64_t slot, int step);

/* priority.c */
int priority_scratch_doubles(int n);
void priority_values(int n, double slot_s, const double *p, const double *v, double *g,
                     double *scratch);
/* g of one agent, the same bits; eta: n doubles. */
double priority_of(int n, double slot_s, const double *p, const double *v, int k, double *eta);
/* -> index of the sender or -1; candidates (n) may be NULL. */
int select_sender(int n, int selection, double epsilon, const double *g, const int64_t *h,
                  const uint8_t *in_ap, uint8_t *candidates, int *reason);

/* urgent.c: as priority_values and select_sender, but g is NaN where the choice does not depend on
 * it. g of the sender is there. */
int select_urgent(const dtsa_config *config, const double *p, const double *v, const int64_t *h,
                  const uint8_t *in_ap, double *g, double *scratch, int *reason);

/* draw.c: what looks random, and is the same for everybody who asks the same */
uint64_t mix64(uint64_t x);
double draw_uniform(uint64_t key, uint64_t what); /* 0 or more, less than 1 */

/* agent.c */
uint64_t common_factor(uint64_t a, uint64_t b); /* the greatest */

/* ---- an agent ---- */

enum { PRESENT_LEAVING = 2 };

typedef struct policy_row policy_row;

struct dtsa_agent {
    dtsa_table *table;
    const policy_row *policy;
    void *state;     /* the policy's, policy->bytes(config) */
    int self;        /* index */
    uint8_t present; /* 0: switched off, neither sends nor flies; 2: leaving */
    uint8_t active;  /* 0: hovers */
    uint8_t final;   /* no further goal is scheduled */
    uint8_t frame_length;
    double position[3], velocity[3], command[3], goal[3];
    dtsa_decision decision;
    uint32_t malformed, foreign;
    uint8_t frame[DTSA_FRAME_MAX]; /* of this slot */
};

/* agent.c */
uint32_t slot_on_air(const dtsa_config *config, int64_t slot); /* see dtsa_slot_cycle */
int agent_far_from_goal(const dtsa_agent *agent);              /* eq:remaining_t_slots */
void agent_forget(dtsa_agent *agent);                          /* table and policy's state */
void agent_decide(dtsa_agent *agent, int64_t slot);
int agent_speak(dtsa_agent *agent, int64_t slot, uint8_t *out); /* -> length of its frame */
void agent_steer(dtsa_agent *agent, int64_t slot,
                 int step); /* command from the estimates there are */

/* table.c, of frames */
typedef struct heard_frame {
    extended_frame e; /* of paper frames only e.own */
    int64_t sampled;  /* slot in which its state was sampled */
} heard_frame;

enum { HEARD = 1, HEARD_MALFORMED = 0, HEARD_FOREIGN = -1 };
/* Reads and checks a frame once, whoever hears it. -> HEARD.. */
int frame_admit(const dtsa_config *config, int64_t slot, const uint8_t *data, long length,
                heard_frame *heard);
/* A table takes in what was heard. -> whether its sender was not in A_p and is now. */
int table_take(dtsa_table *table, const heard_frame *heard);
void agent_take(dtsa_agent *agent, const heard_frame *heard);
/* A sender's entry for itself is its own last SENT state, whether or not anybody heard it; but for
 * a frame in an OPEN turn, where others may send, too. */
void agent_said(dtsa_agent *a, int64_t slot, const uint8_t *data, long length);

/* gossip.c */
int gossip_collect(const dtsa_table *table, int self, int64_t slot, int room,
                   gossip_entry *out); /* -> number */
void gossip_learn(dtsa_table *table, int64_t sampled, const gossip_entry *entry);
/* The same, of the table's own agent: somebody has heard it. */
void gossip_confirm(dtsa_table *table, int64_t sampled, const gossip_entry *entry);

/* avoider/avoider.c: command of one agent from others' states as estimated,
 * docs/reference/settings.md. `ages` may be NULL. */
int avoid_scratch_doubles(int n);

#endif
