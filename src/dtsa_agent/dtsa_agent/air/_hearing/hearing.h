/* What an agent with a clock of its own makes of datagrams: whose they are, what time they say it
 * is, how long they were under way. It knows no port and reads no clock.
 *
 * The same is said in plain Python by test/plain_hearing.py and what it is made of; tests compare
 * the two. Times are ns. */
#ifndef DTSA_HEARING_H
#define DTSA_HEARING_H

#include "contacts.h"
#include "dtsa.h"
#include "port.h"

/* Bytes of a datagram, see datagram.py: those that a swarm agrees on, 8 with the magic of a
 * network; and of how many others a datagram tells, at most. */
enum { WITH_MAGIC = 8, PEERS = 4 };

/* What has come of a datagram. */
typedef enum verdict {
    TAKEN,
    NOT_OURS,
    WRONG_LENGTH,
    OTHER_SETTINGS,
    NO_FRAME,
    UNKNOWN_AGENT,
    REJECTED,
    REPEATED,
    OTHER_TIME,
    OWN_NAME, /* another one speaks in the own name, or plays again what was said there */
    VERDICTS
} verdict;

typedef struct peer {
    int id; /* 0: nobody */
    int64_t late;
} peer;

typedef struct said {
    int sender;
    int64_t slot, late;
    peer peers[PEERS];
    const uint8_t *frame;
    long frame_length; /* without the tag */
} said;

/* clock.py */
enum { DRIFT_MOST = 500000000 }; /* parts per billion, either way */
typedef struct own_clock {
    int64_t began, offset, drift; /* ns CLOCK_MONOTONIC, ns, parts per billion */
} own_clock;

/* delay.py; of each other agent, by index. */
typedef struct delays {
    int64_t limit, error;
    int64_t *hears, *says, *sum; /* (n) */
    int64_t *sums;               /* (count) of all pairs, ascending */
    uint8_t *known;              /* (n) HEARS, SAYS, SUM */
    int count;
    int64_t turn;
} delays;

enum { HEARS = 1, SAYS = 2, SUM = 4 };

typedef struct hearing {
    /* Given. */
    int agents, self; /* number of agents, own index */
    uint8_t header[WITH_MAGIC], key[32];
    int agreed, late_bytes, peers, head; /* of the header: bytes agreed on; 2, or 0: it does not
                                            say how late it left; others told of; all bytes */
    int key_length;                      /* 0: not sealed */
    uint64_t session;
    int64_t flight, slot_ns;
    double position_step;
    int length, own_bytes; /* of a datagram; of these what plug-ins append to a frame */
    own_clock clock;

    /* Its own. */
    dtsa_timebase base;
    unsigned corrected;
    delays delay;
    contacts contact;
    int64_t timed, off; /* frames of about this time; of these off by over a quarter of a slot */
    int64_t *last;      /* (n) slot of the last frame, -1: none */
    int64_t *memory;
} hearing;

/* After what is given is filled in, and the time base made; 0: no memory. */
int hearing_open(hearing *h);
/* The same in the caller's memory: (6 n) all zero, (n). */
void hearing_lay(hearing *h, int64_t *memory, contact *of);
void hearing_close(hearing *h);

int64_t clock_local(const own_clock *clock, int64_t monotonic);
int64_t clock_monotonic(const own_clock *clock, int64_t local);

verdict hearing_read(const hearing *h, const uint8_t *data, long length, said *out);
/* TAKEN: *restarted: its time was taken over, and whatever was known about turns is void. */
verdict hearing_take(hearing *h, const uint8_t *data, long length, int64_t arrival, said *out,
                     int *restarted);
int slots_hear(hearing *h, int64_t slot, int64_t start);
/* The datagram of an own frame of the length that all have; out: LONGEST bytes. */
void hearing_wrap(hearing *h, const uint8_t *frame, int64_t slot, int64_t late, uint8_t *out);

#endif
