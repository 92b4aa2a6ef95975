/* Whole flights: agents in slots on one channel, until the metrics say that it is over. */
#ifndef DTSA_RUN_H
#define DTSA_RUN_H

#include "metrics.h"

enum { SIM_IDLE, SIM_SUCCESS, SIM_COLLISION }; /* outcomes of a slot */

/* Which receivers lose a frame that is alone on the air (dtsa_channel_sim/model/losses.py). Numbers
 * of senders and receivers are (n, n), row = sender. */
typedef struct sim_losses {
    int none;      /* nothing is ever lost */
    int chains;    /* 0: no phases, 1: one chain of phases a receiver, n: one a link */
    int64_t first; /* slot of the first row of words */
    /* Borrowed: */
    uint64_t *words, *state_words;     /* (rows, n) random, of slots and receivers */
    uint64_t *factors, *state_factors; /* (n) make words of links from those of receivers */
    uint64_t *good, *bad;              /* (n, n) words below these are losses */
    uint64_t *enter, *keep, *share;    /* (chains, n) where words decide of a phase */
    uint8_t *phase;                    /* (chains, n) 1: bad, in the slot before */
} sim_losses;

/* What happened, a row a slot. Agents are local ones, all of them; pointers may be NULL. */
typedef struct sim_log {
    int64_t rows, capacity, frames, frame_capacity;
    int observer; /* whose table is followed */
    int frame_bytes;
    /* Borrowed: */
    uint8_t *outcome, *sent, *reason;   /* (), (n) .. */
    uint16_t *chosen, *lost, *collided; /* (n) */
    uint32_t *digest;                   /* (n) */
    double *score;                      /* (n) */
    double *velocity, *command, *goal;  /* (3, n) at the start of the slot */
    double *position;                   /* (steps, 3, n) */
    int64_t *heard_slot;                /* (n) of the observer, as all that follow */
    double *heard_position, *estimate;  /* (3, n) for the start of the next slot */
    uint8_t *in_ap;                     /* (n) */
    uint8_t *received;                  /* a row a frame, (n) */
    uint8_t *data;                      /* a row a frame, (frame_bytes) */
} sim_log;

typedef struct sim_flight {
    swarm *swarm; /* all agents */
    metrics *metrics;
    course *course;    /* NULL: no plan */
    sim_log *log;      /* NULL: nothing is kept */
    uint8_t *received; /* (n) scratch */
    int64_t slot;      /* the next one */
    sim_losses losses;
} sim_flight;

/* Flies some slots, fewer if the flight is over or its log is full. -> METRICS_, why it is over. */
int dtsa_sim_run(sim_flight *f, int64_t slots);
int sim_log_is_full(const sim_log *log, int n);
/* All have decided, and their frames are encoded. */
void sim_log_open(sim_log *log, const swarm *s);
/* The slot is over. received (frames, n) who received each; NULL: all others, or none. */
void sim_log_close(sim_log *log, swarm *s, int64_t slot, int outcome, const uint8_t *received);

#endif
