/* The compiled core of DTSA: types and functions. No I/O, no clock, no hidden state, no allocation in a slot.
 *
 * Ids count from 1 as in the paper; array indices are id - 1. A vector of n agents is three planes of n doubles: all x,
 * all y, all z. All agents must compute the same bits, so the build forbids contraction and fast-math, sums have a
 * fixed order, and no libm function whose last bit depends on the machine is called (only sqrt, which IEEE 754 fixes).
 */
#ifndef DTSA_H
#define DTSA_H

#include <stdint.h>

#include "avoider.h"
#include "vehicle.h"

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
/* Elementwise loops give the same bits at any vector width. */
#define DTSA_SIMD __attribute__((target_clones("avx2", "default")))
#else
#define DTSA_SIMD
#endif

enum { FRAME_MAX = 60 }; /* bytes, Crazyflie peer-to-peer payload */

enum { POLICY_TDMA, POLICY_DTSA, POLICY_AGE, POLICY_ALOHA, POLICY_LEASE, POLICY_EXTERNAL };
enum { ESTIMATE_HOLD, ESTIMATE_LINEAR, ESTIMATE_INTENT, ESTIMATE_ORACLE, ESTIMATE_EXTERNAL };
enum { SELECT_CANDIDATES, SELECT_PAIRWISE, SELECT_COUNT };

/* Why a sender was chosen. Names of all these: names.c. */
enum {
    REASON_NOBODY,   /* A_p is empty and nobody else has a claim */
    REASON_TDMA,     /* slot modulo N */
    REASON_BOOT,     /* boot round: everyone once, in id order */
    REASON_AGE_CAP,  /* silent for longer than the age cap allows */
    REASON_PRIORITY, /* largest g, nobody within epsilon (eq:pfs) */
    REASON_TIE,      /* several within epsilon: largest counter h (eq:secondary) */
    REASON_OLDEST,   /* all g are zero, or policy age: largest counter h */
    REASON_RETURN,   /* slot reserved for the agents outside A_p */
    REASON_RANDOM,   /* aloha */
    REASON_PLUGIN,   /* a user's own policy */
    /* policy lease */
    REASON_LEASE_OWN,     /* the owner's turn */
    REASON_LEASE_ANCHOR,  /* the owner's turn that is never given away */
    REASON_LEASE_LEASED,  /* given away by its owner */
    REASON_LEASE_ADOPTED, /* given away by the next one alive, because its owner is thought dead */
    REASON_LEASE_OPEN,    /* given to whoever has just woken or joined */
    REASON_LEASE_ABSENT,  /* its owner is thought dead */
    REASON_LEASE_PROBATION, /* its owner may not use it yet */
    REASON_COUNT
};

/* ---- frame.c: the radio frame, the only codec ---- */

enum { PROFILE_PAPER = 0, PROFILE_PAPER_INTENT = 1, PROFILE_EXTENDED = 2, PROFILE_COUNT };
enum { FRAME_VERSION = 1 };
enum {
    SECTIONS = 3,
    SECTION_BYTES = 11,
    EXTENDED_HEAD = 23,
    EXTENDED_LENGTH = EXTENDED_HEAD + SECTIONS * SECTION_BYTES
};
enum {
    RELAY_IDS = 8,
    RELAY_REACH = 24,
    GOSSIP_AGE_MAX = 127,
    LEASE_ROOM = 2 * SECTION_BYTES,
    EXTENDED_SENDER_MAX = 254
};
enum { FRAME_OK = 0, FRAME_BAD_LENGTH = -1, FRAME_BAD_HEADER = -2, FRAME_BAD_FIELD = -3 };

typedef struct {
    int profile;
    int sender;        /* id, 1..65535 */
    uint32_t slot;     /* slot the state was sampled in */
    int c_r;           /* transmission parameter (eq:remaining_t_slots), 0..255 */
    double p[3], v[3]; /* m, m/s, frame map */
    double c[3];       /* m/s, commanded velocity; zero without intent */
} dtsa_frame;

int frame_length(int profile);
/* position_step: m, agreed on by the whole swarm; the largest coordinate that fits is 32767 steps. */
int frame_encode(const dtsa_frame *frame, double position_step,
                 uint8_t *out); /* -> length, 0 if a field is not a number */
int frame_decode(const uint8_t *data, long length, double position_step, dtsa_frame *frame);
/* Quantised fields, shared by all profiles; saturate, never wrap. */
int64_t quantise(double value, double step, int bits);

/* ---- frame_extended.c ---- */

typedef struct {
    int id, age, c_r;  /* 1..254; slots since it was sampled, 1..127; 0 or 1 */
    double p[3], v[3]; /* m, m/s, frame map; 4 mm (2 position steps), 2 cm/s on the air */
} gossip_entry;

typedef struct {
    dtsa_frame own;
    int c_s; /* consecutive ids before the sender that it thinks dead, 0..253 */
    int leaving, probation;
    int gossip_count, lease_count;
    uint32_t relay_mask; /* bit d - 1: turn slot + d is leased */
    gossip_entry gossip[SECTIONS];
    uint8_t leases[SECTIONS * SECTION_BYTES];
    uint8_t relay_ids[RELAY_IDS];
} extended_frame;

int extended_encode(const extended_frame *frame, double position_step,
                    uint8_t *out); /* -> length, 0 if not encodable */
int extended_decode(const uint8_t *data, long length, double position_step, extended_frame *frame);
/* Whether gossip can say a state without saturating. */
int gossip_fits(const double p[3], const double v[3], double position_step);

/* ---- priority.c ---- */

int priority_scratch_doubles(int n);
void priority_values(int n, double slot_s, const double *p, const double *v, double *g,
                     double *scratch);
/* -> index of the sender or -1; candidates (n) may be NULL. */
int select_sender(int n, int selection, double epsilon, const double *g, const int64_t *h,
                  const uint8_t *in_ap, uint8_t *candidates, int *reason);

/* ---- swarm.c ---- */

typedef struct lease_config {
    int anchor_every; /* M: every so many rounds an agent's turn is an anchor */
    int open_every; /* S: of the turns given away every so many are open to all who wake; 0: none */
    int adoption;   /* the turns of the dead are given away by the next one alive */
    double depth_rate; /* c: turns given away per round of idleness */
    double share;      /* no leases when more than this share of those alive has something to say */
} lease_config;

typedef struct swarm {
    int n, local_count, table_count, steps;
    int shared; /* one table serves every agent */
    double slot_s, dt;
    int policy, estimator, avoider, selection;
    double epsilon, age_cap;
    int boot_round, return_every;
    double r_min;
    int c_r;
    int targets_known;
    int profile, gossip;
    double position_step; /* m, of positions in frames */
    uint64_t key;
    avoid_params avoid;
    vehicle_params vehicle;
    lease_config lease;

    /* Borrowed from NumPy: v = table_count, l = local_count, n = agents. */
    const int32_t *local;             /* (l) 0-based agent of each local slot */
    const int32_t *observer;          /* (v) 0-based agent of each table, -1: serves all */
    const double *start;              /* (3, n) */
    const double *target;             /* (3, n) */
    double *sent_p, *sent_v, *sent_c; /* (v, 3, n) last heard state */
    int64_t *sent_slot;               /* (v, n), -1: never */
    int64_t *
        last; /* (v, n) slot in which this table last took the agent for the sender; h = slot - 1 - last */
    uint8_t *in_ap;                 /* (v, n) */
    uint32_t *entry_hash;           /* (v, n) */
    uint32_t *table_hash;           /* (v) */
    double *est_p, *est_v;          /* (v, 3, n) */
    double *g;                      /* (v, n) */
    int64_t *h;                     /* (v, n) */
    double *pos, *vel, *cmd, *goal; /* (3, l) */
    double *track;                  /* (steps, 3, l) */
    uint8_t *active;                /* (l) 0: hovers */
    uint16_t *chosen;               /* (l) */
    uint8_t *reason;                /* (l) */
    uint32_t *digest;               /* (l) */
    double *score;                  /* (l) */
    uint8_t *sends;                 /* (l) */
    uint8_t *frame_len;             /* (l) */
    uint8_t *frames;                /* (l, FRAME_MAX) */
    uint8_t *final;                 /* (l) no further goal is scheduled for it */
    uint8_t *
        present; /* (l) 0: switched off (not joined, left or dead): neither sends nor flies; 2: leaving */
    uint8_t *lease_state; /* (l, lease_state_bytes) */
    double *decay;        /* (2, decay_len) intent: q^k and dt * sum q^1..q^k */
    int decay_len;

    /* Owned. */
    double *scratch;
    double *ages;     /* (n) seconds, for the avoider */
    dtsa_frame *own;  /* (l) what was sent in this slot */
    int32_t *senders; /* (l) */
    int sender_count;
    uint64_t malformed, foreign;
} swarm;

enum { PRESENT_LEAVING = 2 };

void swarm_reset_tables(swarm *s);
void swarm_reset_table(swarm *s, int table); /* knows nothing but the settings */
int swarm_far_from_goal(const swarm *s, int l);
void swarm_learn(swarm *s, int table, const dtsa_frame *f, int64_t sampled);
void swarm_estimate(swarm *s, int table, int64_t slot, int step);
void swarm_decide(swarm *s, int64_t slot);
void swarm_emit(
    swarm *s,
    int64_t slot); /* encodes the frames of all whose `sends` is set; lists them in senders */
int swarm_hear(swarm *s, int64_t slot, const uint8_t *data, long length, const uint8_t *mask);
void swarm_end(swarm *s, int64_t slot);
void swarm_steer(swarm *s, int64_t slot, int step, int estimate);
void swarm_move(swarm *s, int step);
void swarm_fly(swarm *s, int64_t slot);
uint64_t mix64(uint64_t x);

/* ---- gossip.c ---- */

int gossip_collect(const swarm *s, int table, int self, int64_t slot, int room,
                   gossip_entry *out); /* -> number */
int extended_emit(swarm *s, int l, int64_t slot, const dtsa_frame *own, uint8_t *out);
int extended_hear(swarm *s, int64_t slot, const uint8_t *data, long length, const uint8_t *mask);

/* ---- metrics.c ---- */

typedef struct {
    double *path;          /* (n) m, distance flown */
    double *last_position; /* (3, n) */
    double min_distance2;
    int pair[2];
    int64_t min_slot;
    int64_t age_count, age_sum, age_max;
    double error_sum, error_max;
} metrics;

/* -> 1 if two agents are closer than `collision_m`. */
int metrics_distance(metrics *m, int n, int steps, int64_t slot, const double *track,
                     double collision_m);
/* -> 1 if all moving agents are within `r_min` of their targets. */
int metrics_arrived(int n, const double *now, const double *target, const uint8_t *moving,
                    double r_min);
void metrics_news(metrics *m, swarm *s, int64_t slot, const double *truth, const uint8_t *moving);

#endif
