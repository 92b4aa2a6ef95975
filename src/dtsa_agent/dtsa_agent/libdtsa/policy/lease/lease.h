/* Policy lease: only whose turn it is gives it away (docs/reference/protocol.md). */
#ifndef DTSA_LEASE_H
#define DTSA_LEASE_H

#include "../policy.h"

enum {
    LEASE_DEAF = 4,   /* more silent slots in a row than this, and an agent is presumed deaf */
    LEASE_MISSED = 4, /* who missed so many expected turns gets no leases */
    LEASE_HANDED =
        255 /* in place of an issuer: this agent was given the turn, and has handed it on */
};

/* State of one agent; followed in memory by heard (n), lessee (w), issuer (w), miss (n), quiet (n),
 * settled (n), resting (n). */
typedef struct lease_agent {
    int64_t born;       /* slot of the first decision since the (re)start */
    int64_t now;        /* the ring holds the turns now .. now + w - 1 */
    int64_t idle_since; /* -1: has something to say */
    int64_t woke;    /* slot in which it woke or joined and since when nobody is known to have heard
                        it, -1: none */
    int64_t claimed; /* slot in which probation began or was last confirmed */
    int64_t spoke;   /* slot of the last frame of its own, -1: none */
    double wakers;   /* agents that woke lately: about so many in the last n slots */
    int32_t expected; /* 0-based agent expected in this slot, -1: nobody in particular */
    int32_t deaf;     /* silent slots in a row */
    uint8_t started, heard_now, probation, anchored, attempts, moving, leaving;
} lease_agent;

typedef struct lease_scope {
    lease_agent *a;
    int64_t *heard;   /* (n) last slot of which it is known that the agent lived, -1: never */
    uint8_t *lessee;  /* (w) LEASE_NONE, id of the lessee, LEASE_OPEN */
    uint8_t *issuer;  /* (w) id of who gave the turn away, 0: known by relay only; LEASE_HANDED */
    uint8_t *miss;    /* (n) expected turns missed in a row */
    uint8_t *quiet;   /* (n) in probation: sends in anchors only */
    uint8_t *settled; /* (n) gives anchors away, for it knows that it will rest */
    uint8_t *resting; /* (n) had nothing to say in its last frame */
    int n, window, self;
    int every, main;  /* rounds from one anchor to the next, M; from one main anchor to the next */
    int64_t patience; /* slots without a sign of life after which an agent is thought absent */
    int64_t long_patience; /* the same for those that rest, or were never heard */
} lease_scope;

lease_scope lease_of(const dtsa_agent *agent);
int lease_is_anchor(const lease_scope *v, int64_t slot);
int lease_is_main(const lease_scope *v, int64_t slot); /* an anchor that nobody gives away */
int lease_absent(const lease_scope *v, int k, int64_t slot);
int lease_alive(const lease_scope *v, int k, int64_t slot);
int lease_scheduled(const lease_scope *v,
                    int64_t slot); /* 0-based agent whose turn it is in this table, -1: nobody's */
/* Takes note of what a frame of `slot` from `sender` (an id) says of a turn. issuer: who gave it
 * away, 0: the sender relays it. */
void lease_note(lease_scope *v, int64_t slot, int sender, int64_t turn, int lessee, int issuer);
/* The turns a frame's lease bytes speak of, in order; the same for sender and receiver. -> number
 * of turns. */
int lease_turns(const lease_scope *v, int64_t slot, int c_s, int64_t *turns, int room);

/* issue.c */
void lease_fill(dtsa_agent *agent, int64_t slot, extended_frame *e);

#endif
