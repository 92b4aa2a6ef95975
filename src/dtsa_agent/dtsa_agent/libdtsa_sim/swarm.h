/* Many agents and tables at once, with vehicles: what simulator, nodes and verifier hold. Arrays
 * are the caller's. */
#ifndef DTSA_SWARM_H
#define DTSA_SWARM_H

#include "core.h"
#include "course.h"
#include "dtsa_station.h"
#include "policy/policy.h"
#include "vehicle.h"

typedef struct swarm {
    dtsa_config config;
    int local_count, table_count;
    int shared;      /* one table serves every agent */
    int announce;    /* an agent with a new goal hovers until it has sent a frame that says so */
    int goals_known; /* all know where everybody wants to be in each slot */
    vehicle_params vehicle;

    /* Borrowed: v = table_count, l = local_count, n = agents; p = swarm_policy_bytes. */
    int32_t *local;    /* (l) 0-based agent of each local slot */
    int32_t *observer; /* (v) 0-based agent of each table, -1: serves all */
    double *sent_position, *sent_velocity, *sent_intent; /* (v, 3, n) tables: see core.h */
    double *innovation;                                  /* (v, n) */
    int64_t *sent_slot, *last_turn;                      /* (v, n) */
    uint8_t *in_ap;                                      /* (v, n) */
    uint32_t *entry_hash;                                /* (v, n) */
    uint32_t *table_hash;                                /* (v) */
    double *estimate_position, *estimate_velocity;       /* (v, 3, n) */
    double *priority;                                    /* (v, n) */
    int64_t *counter;                                    /* (v, n) */
    double *position, *velocity, *command, *goal;        /* (3, l) */
    double *known_goal;                                  /* (3, n) where all take those who rest */
    double *track;                                       /* (steps, 3, l) */
    uint8_t *active, *final, *present;                   /* (l) see core.h */
    uint16_t *chosen;                                    /* (l) */
    uint8_t *reason;                                     /* (l) */
    uint32_t *digest;                                    /* (l) */
    double *score;                                       /* (l) */
    uint8_t *sends;                                      /* (l) */
    int32_t *senders;      /* (l) places of those that send in this slot */
    uint8_t *frame_length; /* (l) */
    uint8_t *frames;       /* (l, DTSA_FRAME_MAX) */
    uint8_t *lease_state;  /* (l, p) */
    uint64_t *rejects;     /* (2) frames heard that were malformed, foreign */

    /* Owned. */
    dtsa_table *tables; /* (v) */
    dtsa_agent *agents; /* (l) */
    double *scratch, *ages;
    int sender_count;
} swarm;

size_t swarm_policy_bytes(const dtsa_config *config); /* of an agent's own state, 0: none */
/* After configuration and arrays are filled in; -> what is wrong, or NULL. */
const char *swarm_open(swarm *s);
void swarm_close(swarm *s);

void swarm_reset(swarm *s);
void swarm_restart(swarm *s, int l); /* knows nothing but the settings */
/* A slot begins: goals and activity of the agents, by the plan of the scenario. */
void swarm_advance(swarm *s, course *c, int64_t slot);
void swarm_decide(swarm *s, int64_t slot);
/* Encodes the frames of all whose `sends` is set; lists them in senders; -> their number. */
int swarm_emit(swarm *s, int64_t slot);
int swarm_begin(swarm *s, int64_t slot); /* decides and emits */
/* mask (v): which tables hear it; NULL: all. -> whether it was a frame of this swarm and time. */
int swarm_hear(swarm *s, int64_t slot, const uint8_t *data, long length, const uint8_t *mask);
void swarm_end(swarm *s, int64_t slot);
void swarm_estimate(swarm *s, int table, int64_t slot, int step);
void swarm_estimate_all(swarm *s, int64_t slot, int step);
void swarm_steer(swarm *s, int64_t slot, int step, int estimate);
void swarm_move(swarm *s, int step);
/* estimated: the estimates of all tables are those for the start of the slot. */
void swarm_fly(swarm *s, int64_t slot, int estimated);
/* The rest of a slot whose frames are the swarm's own: fly, hear, end. heard (senders, v): which
 * tables hear each; NULL: `all` of them, or none. */
void swarm_complete(swarm *s, int64_t slot, int estimated, int all, const uint8_t *heard);

/* The only local agent of a swarm behind a station. */
typedef struct swarm_pilot {
    swarm *swarm;
    int moves; /* it flies unless the station says that it hovers; where nothing is prepared */
    void *context;
    /* Before it decides for a slot: writes its state, goal and activity. NULL: they stay as they are. */
    void (*prepare)(void *context, int64_t slot, int hovers);
} swarm_pilot;
/* Its pilot is the context, and has to stay. */
dtsa_station_agent swarm_station_agent(swarm_pilot *pilot);

/* What local agents with tables of their own, from `first` up to `end`, have heard before a slot,
 * as numbers for learning. Of each: SWARM_OBSERVED_OWN, and SWARM_OBSERVED_PLANES of n, itself first
 * and those with the next ids. */
enum { SWARM_OBSERVED_OWN = 10, SWARM_OBSERVED_PLANES = 9 };
void swarm_observe(const swarm *s, int64_t slot, int first, int end, float *out);

#endif
