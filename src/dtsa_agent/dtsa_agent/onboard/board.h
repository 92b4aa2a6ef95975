/* One agent of a swarm on a microcontroller: its loop, which waits for its slots and for frames. It
 * knows no firmware, clock or radio: the caller says what time it is, where the vehicle is and what
 * has arrived, sends what it is given, and steers as it is told. It does what air/agent.py does on a
 * computer, with the same hearing (air/_hearing) and the same libdtsa.
 *
 * Times are ns of the own clock. Nothing here allocates memory. */
#ifndef DTSA_BOARD_H
#define DTSA_BOARD_H

#include "dtsa.h"
#include "hearing.h"

enum {
    BOARD_AGENTS = 20,  /* N at most */
    BOARD_BYTES = 8704, /* of an agent with so many */
    BOARD_EARLY = 4,    /* frames of slots that are still to come */
    BOARD_DATAGRAM = DTSA_FRAME_MAX
};

typedef struct board_settings {
    int id;
    int64_t slot_ns, flight_ns; /* length of a slot; from the order to send to the arrival */
    uint64_t seed;
    int64_t begin; /* in this slot all begin anew together, with the configured policy and slot 0;
                      until then they find a common time with tdma. 0: they need not */
    uint8_t header[2];  /* with which datagrams of the swarm begin that are not sealed */
    const uint8_t *key; /* NULL: frames are not sealed */
    int key_length;
    uint64_t session;
} board_settings;

struct board;

/* Is told what happens, for a record of the flight; on a vehicle there is none. */
typedef struct board_watch {
    void (*opened)(const struct board *b, int64_t now_ns);
    void (*anew)(const struct board *b); /* the slot is over; it begins anew with the next one */
    void (*sent)(const struct board *b, const uint8_t *datagram, int length, int64_t now_ns);
    /* When its slot has begun. */
    void (*heard)(const struct board *b, int sender, int64_t slot, const uint8_t *datagram,
                  int length, int64_t arrival_ns, int accepted);
} board_watch;

typedef struct board_counts {
    uint32_t sent, heard, unsent, restarts, refused[VERDICTS], early, slots;
} board_counts;

typedef struct board {
    dtsa_config config; /* filled in by the caller before board_start, with starts and targets */
    board_settings settings;
    const board_watch *watch; /* NULL: nobody is told */
    hearing hearing;
    dtsa_agent *agent;
    int64_t slot, first; /* the present slot, the one with which it began; -1: none */
    int64_t lead_ns, latest_lead_ns, latest_send_ns, too_long_ns;
    int running, anew; /* a slot is open; it is the first one */
    int policy;        /* with which it begins, once all have a common time; else -1 */
    int awaits;        /* the slot's sender is another one, and has not been heard yet */
    int newcomer;      /* it hovers until the others know it */
    int spoke;         /* it has sent in a turn of its own since it began */
    double command[3]; /* m/s, when the present slot was opened */
    int waiting;       /* bytes of the frame that lies ready */
    uint8_t frame[DTSA_FRAME_MAX];
    struct {
        int64_t slot, arrival;
        int sender, length;
        uint8_t datagram[BOARD_DATAGRAM];
    } early[BOARD_EARLY];
    int early_count;
    int64_t heard_ns[BOARD_AGENTS]; /* when each was heard last; INT64_MIN: never */
    board_counts counts;
    double memory[BOARD_BYTES / sizeof(double)];
    int64_t delays[6 * BOARD_AGENTS];
    contact contacts[BOARD_AGENTS];
} board;

/* Begins to listen. The name of a setting that cannot be; NULL: it listens. */
const char *board_start(board *b, const board_settings *settings, int64_t now_ns);

/* A datagram has arrived. Whatever it is, it may be handed in. */
verdict board_hear(board *b, const uint8_t *data, long length, int64_t arrival_ns);

/* Does one thing that is due: position (m) and velocity (m/s) count where it decides. Returns when
 * to call again at the latest; now: at once. *length > 0: send these bytes now. */
int64_t board_step(board *b, int64_t now_ns, const double position[3], const double velocity[3],
                   uint8_t datagram[BOARD_DATAGRAM], int *length);

/* Where to fly, m/s, in the present slot; 0: nowhere, it hovers, command is zero. */
int board_command(board *b, int64_t now_ns, double command[3]);

/* The same for one that stays at a place (m, frame map) and gives way to those it has heard of. */
int board_stay(board *b, int64_t now_ns, const double place[3], double command[3]);

/* Slots since an agent's news was new, by index; -1: nothing is known of it. */
int64_t board_age(const board *b, int index);
/* Whether it rests, as far as is known. */
int board_rests(const board *b, int index);
/* Where it was heard to be, m, in direction 0 to 2. */
double board_place(const board *b, int index, int direction);

#endif
