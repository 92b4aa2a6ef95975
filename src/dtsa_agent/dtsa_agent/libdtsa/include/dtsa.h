/* libdtsa: one agent of a swarm that shares a radio channel in slots. Protocol and frames:
 * docs/reference/protocol.md.
 *
 * No Python, ROS, clock, heap, I/O, or function of libm but sqrt: the caller owns memory, time and
 * radio. All agents compute the same bits on every machine with IEEE 754 doubles: compile without
 * fast-math and with -ffp-contract=off.
 *
 * Ids count from 1, as in the paper; indices are id - 1. Times are slot numbers, or ns of the
 * caller's own clock. Metres, m/s, frame map. A vector of N agents is three planes of N doubles:
 * all x, all y, all z.
 *
 * Use:
 *     size_t bytes = dtsa_agent_bytes(&config);              once; 0: config is not usable
 *     dtsa_agent *agent = dtsa_agent_start(memory, bytes, &config, id);
 *     in every slot:
 *         dtsa_agent_set_state(agent, position, velocity);   own state at the slot's start
 *         length = dtsa_agent_slot(agent, slot, frame);      decides; > 0: send these bytes now
 *         dtsa_agent_command(agent, slot, step, command);    where to fly, at each control instant
 *         dtsa_agent_hear(agent, slot, data, length);        for each frame received
 *         dtsa_agent_end(agent, slot);                       the slot is over
 *
 * Version: major * 100 + minor. The minor number grows when something is added at the end of a
 * structure or a list, or a function is added; the major number when anything else here changes, or
 * the bytes of a frame do. Structures are filled by name; a field that is zero has the meaning it
 * had before there was such a field.
 */
#ifndef DTSA_H
#define DTSA_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define DTSA_VERSION 200

#if defined(__GNUC__)
#define DTSA_API __attribute__((visibility("default")))
#else
#define DTSA_API
#endif

/* The version that was compiled; compare with DTSA_VERSION. */
DTSA_API int dtsa_version(void);

/* ---- configuration: what all agents of a swarm must agree on ---- */

enum {
    DTSA_FRAME_MAX = 60, /* bytes, Crazyflie peer-to-peer payload */
    DTSA_TAG_BYTES = 4,
    DTSA_AGENTS_MAX = 1024,
    DTSA_EXTENDED_AGENTS_MAX = 254 /* ids have 8 bits in extended frames */
};

enum {
    DTSA_POLICY_TDMA,
    DTSA_POLICY_DTSA,
    DTSA_POLICY_AGE,
    DTSA_POLICY_ALOHA,
    DTSA_POLICY_LEASE,
    DTSA_POLICY_INNOVATION,
    DTSA_POLICY_EXTERNAL /* the caller decides */
};
enum {
    DTSA_ESTIMATE_HOLD,
    DTSA_ESTIMATE_LINEAR,
    DTSA_ESTIMATE_INTENT,
    DTSA_ESTIMATE_ORACLE, /* the truth: filled in by a simulator */
    DTSA_ESTIMATE_EXTERNAL
};
enum { DTSA_SELECT_CANDIDATES, DTSA_SELECT_PAIRWISE, DTSA_SELECT_COUNT };
enum { DTSA_PROFILE_PAPER, DTSA_PROFILE_PAPER_INTENT, DTSA_PROFILE_EXTENDED, DTSA_PROFILE_COUNT };
enum { DTSA_AVOID_ORCA, DTSA_AVOID_POTENTIAL, DTSA_AVOID_BVC, DTSA_AVOID_NONE, DTSA_AVOID_COUNT };

/* Why a sender was expected. */
enum {
    DTSA_REASON_NOBODY,   /* A_p is empty and no other agent has a claim */
    DTSA_REASON_TDMA,     /* slot modulo N */
    DTSA_REASON_BOOT,     /* boot round: everyone once, in id order */
    DTSA_REASON_AGE_CAP,  /* silent for longer than the age cap allows */
    DTSA_REASON_PRIORITY, /* largest g, no other within epsilon (eq:pfs) */
    DTSA_REASON_TIE,      /* several within epsilon: largest counter h (eq:secondary) */
    DTSA_REASON_OLDEST,   /* all g are zero, or policy age: largest counter h */
    DTSA_REASON_RETURN,   /* slot reserved for the agents outside A_p */
    DTSA_REASON_RANDOM,   /* aloha */
    DTSA_REASON_PLUGIN,   /* a user's own policy */
    /* policy lease */
    DTSA_REASON_LEASE_OWN,       /* the owner's turn */
    DTSA_REASON_LEASE_ANCHOR,    /* the owner's turn that is never given away */
    DTSA_REASON_LEASE_LEASED,    /* given away by its owner */
    DTSA_REASON_LEASE_ADOPTED,   /* given away by the next one alive: its owner is thought dead */
    DTSA_REASON_LEASE_OPEN,      /* given to agents that have just woken or joined */
    DTSA_REASON_LEASE_ABSENT,    /* its owner is thought dead */
    DTSA_REASON_LEASE_PROBATION, /* its owner may not use it yet */
    DTSA_REASON_INNOVATION, /* policy innovation: largest counter h, weighed by the change of velocity */
    DTSA_REASON_COUNT
};

/* Parameters of all avoiders; which fields count depends on the avoider. Formulas and defaults:
 * docs/reference/settings.md. All are doubles, so that bindings can read them as a list. */
typedef struct dtsa_avoid_params {
    double v_max;       /* m/s, largest commanded speed */
    double gain;        /* 1/s, K_P: v_pref = min(v_max, gain * distance) towards the goal */
    double radius;      /* m, orca: R_c, pair radius; bvc: radius of one agent */
    double horizon;     /* s, orca: T, look-ahead; bvc: the cell is cut off at horizon * v_max */
    double softness;    /* 1, orca: rho, weight of a violated half-plane */
    double bias;        /* 1, orca: beta, right-hand bias */
    double period;      /* s, orca: T_s, time in which an existing overlap is resolved (0.2) */
    double influence;   /* m, potential: r_inf */
    double strength;    /* m^2/s, potential: k */
    double core;        /* m, potential: d_c */
    double tangential;  /* 1, potential: share of the sideways force */
    double margin_rate; /* m/s, growth of a neighbour's margin with the age of its state, 0: none */
    double margin_max;  /* m, largest such margin */
    double sidestep;  /* m, bvc: nearer than this to its cell's wall an agent steps to its right */
    double stretch_z; /* 1, bvc: height of an agent's ellipsoid over its width (downwash) */
} dtsa_avoid_params;

#define DTSA_AVOID_PARAM_COUNT ((int)(sizeof(dtsa_avoid_params) / sizeof(double)))

/* Settings of policy lease. */
typedef struct dtsa_lease_config {
    int anchor_every; /* M: every so many rounds an agent's turn is an anchor, 1..15 */
    int open_every; /* S: of the turns given away every so many are open to agents that wake; 0: none */
    int adoption;      /* the turns of absent agents are given away by the next agent alive */
    double depth_rate; /* c: turns given away per round of idleness */
    double share;      /* no leases when more than this share of the agents alive is in A_p */
    int64_t patience;  /* slots of silence after which an agent is thought absent; 0: max(1000, 6 M
                          N), 6 K M N if it rests */
    int main_every;    /* K M: every so many rounds an anchor is a main one, a multiple of M, 15 at
                          most; 0: M */
} dtsa_lease_config;

typedef struct dtsa_config {
    int agents;    /* N */
    double slot_s; /* t_s, s */
    int steps;     /* control instants a slot */
    int policy, estimator, avoider, selection, profile;
    double epsilon, age_cap; /* eq:pfs; 0: no cap */
    int boot_round, return_every;
    double r_min;         /* m, at its goal (eq:remaining_t_slots) */
    int c_r;              /* the constant C of eq:remaining_t_slots, 1..255 */
    int targets_known;    /* all agents know the targets of all */
    int gossip;           /* extended frames carry what was heard of others */
    double position_step; /* m, of positions in frames */
    uint64_t key;         /* of all draws */
    dtsa_avoid_params avoid;
    dtsa_lease_config lease;
    const double *start, *target; /* (3, N) m; the caller's, as long as there are agents */
    const double *decay;          /* (2, decay_len), estimator intent: see dtsa_decay */
    int decay_len;                /* 1 or more with estimator intent */
} dtsa_config;

/* Slot numbers on the air count modulo this: the largest multiple, up to 2^32, of all that policies
 * which agents can join count in slots. An agent that joins then takes the same turns as the others. */
DTSA_API uint64_t dtsa_slot_cycle(const dtsa_config *config);

/* The name of a field that is out of range; NULL: all are fine. */
DTSA_API const char *dtsa_config_fault(const dtsa_config *config);

/* Names of everything that has a number: policies, estimators, avoiders, selections, profiles,
 * reasons. */
typedef struct dtsa_name_list {
    const char *kind;
    const char *const *names;
    int count;
} dtsa_name_list;

DTSA_API const dtsa_name_list *dtsa_names(int list); /* NULL: there are no more */

/* How an unsaturated vehicle with time constant tau (s) approaches its command: q^k, and dt (q + ..
 * + q^k), with q = 1 - dt / tau, for k = 0 .. length - 1. */
DTSA_API void dtsa_decay(double tau, double dt, int length, double *table);

/* ---- an agent ---- */

typedef struct dtsa_agent dtsa_agent;

typedef struct dtsa_decision {
    int chosen;      /* id that it takes for the slot's sender, 0: no agent */
    int reason;      /* DTSA_REASON_ */
    int sends;       /* it is itself */
    double score;    /* g of the chosen, where the policy computed it */
    uint32_t digest; /* of its table: equal digests, equal tables */
} dtsa_decision;

typedef struct dtsa_status {
    uint32_t malformed, foreign; /* frames heard that were none, or of another swarm or time */
    /* policy lease */
    int probation;     /* uses its anchors only */
    int deaf;          /* has heard nothing for so long that it gives no turns away */
    int silent_slots;  /* silent slots in a row */
    int alive, absent; /* number of agents, itself among those alive */
    int64_t woke; /* slot in which it woke or joined, -1: it is known to have been heard since */
} dtsa_status;

/* Bytes of memory that an agent needs; 0: the configuration is not usable. */
DTSA_API size_t dtsa_agent_bytes(const dtsa_config *config);

/* An agent in `memory`, aligned for doubles; NULL if it is too small, or id or configuration are
 * not usable. It keeps a pointer to the configuration. It is at its start position and wants to fly
 * to its target. */
DTSA_API dtsa_agent *dtsa_agent_start(void *memory, size_t bytes, const dtsa_config *config,
                                      int id);

/* Its program starts anew: it forgets everything but its settings, its state and its goal. */
DTSA_API void dtsa_agent_restart(dtsa_agent *agent);

/* Switched off it neither decides nor sends, and forgets everything. */
DTSA_API void dtsa_agent_switch(dtsa_agent *agent, int on);

/* It leaves: with policy lease after a frame in its next own turn that says so, with others at
 * once. */
DTSA_API void dtsa_agent_leave(dtsa_agent *agent);
DTSA_API int dtsa_agent_is_on(const dtsa_agent *agent);

/* It hovers: what it commands is zero, and so is the command in its frames. */
DTSA_API void dtsa_agent_hover(dtsa_agent *agent, int hovers);

/* Own true state at the start of the slot, m and m/s, frame map; finite. Within r_min of its goal it
 * is idle; farther away it wakes. */
DTSA_API void dtsa_agent_set_state(dtsa_agent *agent, const double position[3],
                                   const double velocity[3]);

/* Where it flies to, m, frame map; final: no further goal is scheduled. */
DTSA_API void dtsa_agent_set_goal(dtsa_agent *agent, const double goal[3], int final);

/* A slot opens. Returns the length of the frame to send in it, bytes; 0: it is silent. Slots ascend
 * from 0; some may be left out. */
DTSA_API int dtsa_agent_slot(dtsa_agent *agent, int64_t slot, uint8_t frame[DTSA_FRAME_MAX]);
/* The frame of this slot has not been sent: the agent has been silent. */
DTSA_API void dtsa_agent_unsent(dtsa_agent *agent);
DTSA_API dtsa_decision dtsa_agent_decision(const dtsa_agent *agent);

/* A frame was heard in a slot, before the slot's end; also the own one may be handed in. Any bytes
 * are allowed: what is no frame is counted (dtsa_status). Returns 1 if it was a frame of this swarm
 * and time, else 0. */
DTSA_API int dtsa_agent_hear(dtsa_agent *agent, int64_t slot, const uint8_t *data, long length);

/* A slot is over: all that was heard in it has been handed in. */
DTSA_API void dtsa_agent_end(dtsa_agent *agent, int64_t slot);

/* Commanded velocity, m/s, frame map, at control instant `step` of a slot, 0 to steps - 1; frames
 * carry the last one where the profile says so. */
DTSA_API void dtsa_agent_command(dtsa_agent *agent, int64_t slot, int step, double command[3]);

DTSA_API dtsa_status dtsa_agent_status(const dtsa_agent *agent);

/* ---- authentication: a frame is followed by 4 bytes that only holders of the key can make ---- */

/* BLAKE2s, keyed, person "dtsa v1", over session (8 bytes), slot (8 bytes) and data of `length`
 * bytes. key_length: 16 to 32 bytes. */
DTSA_API void dtsa_tag(const uint8_t *key, int key_length, uint64_t session, uint64_t slot,
                       const uint8_t *data, long length, uint8_t tag[DTSA_TAG_BYTES]);
/* Length of the frame without its tag, bytes; 0: it is not authentic. It may come up to `late` slots
 * after its own. Any bytes are allowed. */
DTSA_API long dtsa_open(const uint8_t *key, int key_length, uint64_t session, int64_t slot,
                        int late, const uint8_t *data, long length);

#ifdef __cplusplus
}
#endif

#endif
