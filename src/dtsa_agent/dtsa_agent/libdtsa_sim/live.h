/* Stations on virtual time: one medium, clocks, ports and faults, all from one seed. */
#ifndef DTSA_LIVE_H
#define DTSA_LIVE_H

#include "dtsa_station.h"

enum { LIVE_HOSTS_MAX = 64, LIVE_FAULTS_MAX = 64 };

/* What may happen. agent: host it happens to; group: bits of hosts; amount: see each. */
enum {
    LIVE_LOSS,      /* amount: share of frames that are lost */
    LIVE_JITTER,    /* amount: ns, frames arrive later by up to this, at random */
    LIVE_DELAY,     /* amount: ns, frames of the agent arrive later by this */
    LIVE_DUPLICATE, /* amount: share of frames that arrive twice */
    LIVE_CORRUPT,   /* amount: share of frames with a wrong byte */
    LIVE_REPLAY,    /* amount: frames a second, of those sent so far, played again */
    LIVE_FORGE,     /* amount: frames a second with random slots and senders */
    LIVE_ONE_WAY,   /* the agent is not heard by those of the group */
    LIVE_PARTITION, /* those of the group and the others do not hear each other */
    LIVE_MUTE,      /* the agent is not heard */
    LIVE_DEAF,      /* the agent hears nothing */
    LIVE_REFUSE,    /* the agent's port takes nothing */
    LIVE_STALL,     /* the agent's process stands; frames wait in its port */
    LIVE_SUSPEND,   /* its computer stands, and its clock */
    LIVE_STEP,      /* its clock steps by amount ns, once */
    LIVE_CRASH,     /* its process ends, and is started again at the end */
    LIVE_LEAVE,     /* it leaves, and is started again at the end */
    LIVE_SAME_ID,   /* a second process of its id is there */
    LIVE_FAULT_COUNT
};

typedef struct live_fault {
    int32_t kind, agent;
    uint64_t group;
    int64_t at_ns, lasts_ns;
    double amount;
} live_fault;

typedef struct live_host {
    int64_t start_ns; /* when its process starts */
    int64_t clock_ns; /* what its clock shows at time 0 */
    int64_t drift_ppb;
} live_host;

typedef struct live_flight {
    dtsa_config config;
    dtsa_station_settings station; /* id, key and origin apart: the same for all */
    uint64_t seed;
    int64_t latency_ns, jitter_ns,
        wake_ns;               /* least delay, and at random; a process wakes late by up
                                               to this */
    int64_t airtime_ns;        /* frames that overlap are lost; 0: they do not disturb each other */
    int64_t heal_ns, bound_ns; /* when all faults are over; after which all shall be in step */
    int64_t first_slot;        /* 0: all listen; else all begin together with this slot */
    int64_t goal_every_ns;     /* goals change so often, 0: never */
    live_host hosts[LIVE_HOSTS_MAX];
    int fault_count;
    live_fault faults[LIVE_FAULTS_MAX];
} live_flight;

enum {
    LIVE_FINE,
    LIVE_TWO_SENDERS,    /* two agents in step have sent in one slot */
    LIVE_WITHOUT_QUORUM, /* an agent flies that hears, or is heard by, too few */
    LIVE_NOT_TOGETHER,   /* not all in step, heard and flying when the bound is over */
    LIVE_SPINS,          /* a station asks to be called again and again */
    LIVE_VIOLATION_COUNT
};

typedef struct live_result {
    int violation, agent, other;
    int64_t at_ns;
    int64_t together_ns; /* after healing, -1: not */
    uint64_t hash;       /* of every byte sent, and when */
    double agent_s;
    uint64_t sent, steps, collided,
        shared;              /* frames; calls; lost by overlap; slots with two senders */
    uint64_t hovered, flown; /* slots */
    uint32_t restarts, shifts;
} live_result;

enum { LIVE_STARTED, LIVE_RECEIVED, LIVE_STEPPED, LIVE_SENT, LIVE_LEFT, LIVE_ENDED, LIVE_NEW_GOAL };

/* A call of a station, for whoever makes them again: after it, its answer. */
typedef struct live_call {
    int host, kind;
    int64_t now_ns;
    const uint8_t *data;
    long length;
    int64_t answer; /* verdict, next wake-up, or the id that started */
    const uint8_t *out;
    int out_length;
    double position[3], velocity[3];
    const dtsa_station_status *status; /* after a step; else NULL */
} live_call;

typedef void (*live_observer)(void *context, const live_call *call);

/* 0: no memory, or a station cannot be made. observer may be NULL. */
int live_fly(const live_flight *flight, live_result *result, live_observer observer, void *context);

#endif
