/* A station: one agent with a clock of its own. Datagrams and time in, datagrams and the time of the
 * next wake-up out. It knows no clock, radio or vehicle and allocates no memory: on a computer, on a
 * microcontroller and in the simulator the same code runs. The rules: docs/reference/protocol.md.
 *
 * Use:
 *     size_t bytes = dtsa_station_bytes(&settings);                 once; 0: settings are not usable
 *     dtsa_station *station = dtsa_station_start(memory, bytes, &settings, &agent, now);
 *     for each datagram:  dtsa_station_receive(station, data, length, arrival);
 *     when it is due:     due = dtsa_station_step(station, now, datagram, &length);
 *                         length > 0: send these bytes now, then dtsa_station_sent(station, now, 1)
 *
 * Times are ns of the own clock. Datagrams are handed in by their time of arrival, before the step. */
#ifndef DTSA_STATION_H
#define DTSA_STATION_H

#include "dtsa.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Of a slot, in thousandths, between a frame that left late and the next slot: clocks differ. */
enum { DTSA_BETWEEN = 200 };

/* If the policy needs equal tables, an agent waits for a frame until after the start of its own slot:
 * thousandths of a slot, and ns, whichever is less. Sending late costs less than tables that differ. */
enum { DTSA_MAX_WAIT = 300, DTSA_MAX_WAIT_NS = 3000000 };

enum { DTSA_DATAGRAM_MAX = 512, DTSA_HEADER_MAX = 8, DTSA_NAMES_MAX = 4 };

/* What carries the datagrams; the same for all stations of a swarm. A datagram is the header, how
 * late it left (2 bytes), names of heard agents (4 bytes each: id, and how late it is heard), the
 * frame and its tag. */
typedef struct dtsa_link {
    uint8_t header[DTSA_HEADER_MAX]; /* equal for all of a swarm */
    int header_length;               /* 8: with the magic bytes of a network; 0 to 4 elsewhere */
    int says_late;                   /* datagrams say how late they left */
    int names;                       /* heard agents that a datagram names, 0 to 4 */
    int64_t flight_ns;               /* from the order to send until the arrival */
    int64_t trust_ns;                /* frames that are off by more do not show where slots begin */
} dtsa_link;

enum { DTSA_QUORUM_ALL_BUT_ONE = -1, DTSA_QUORUM_SHARE = -2 };

typedef struct dtsa_station_settings {
    int id, agents;
    int anchor_every, main_every; /* an agent sends at least so often, in rounds; one that rests */
    uint64_t slot_cycle;          /* dtsa_slot_cycle of the configuration */
    int extended;                 /* profile of the frames */
    int own_bytes;                /* that plug-ins append to a frame */
    int frame_length;             /* with them, without a tag */
    double position_step;         /* m */
    int64_t slot_ns;
    uint64_t seed;
    int sends;  /* DTSA_SENDS_..: after which time without a frame an agent counts as silent */
    int quorum; /* others to hear and be heard by: a number, or DTSA_QUORUM_.. */
    double quorum_share; /* of the others, 0 to 1 */
    const uint8_t *key;  /* NULL: frames carry no tag */
    int key_length;
    uint64_t session;
    int early_count; /* frames of slots still to come that are kept, 1 or more */
    int begins;      /* DTSA_BEGINS_.. */
    int64_t origin_ns;
    int keeps_time;   /* DTSA_KEEPS_..: whatever it hears, its slots keep their numbers */
    int equal_tables; /* the policy needs equal tables: it waits longer for frames, and never restarts
                         by itself */
    dtsa_link link;
} dtsa_station_settings;

/* How regularly agents send: in anchors (lease); in turns; at random, so that agents at their goals may
 * stay silent for ever. */
enum { DTSA_SENDS_IN_ANCHORS, DTSA_SENDS_IN_TURNS, DTSA_SENDS_BY_CHANCE };

/* How a station begins: listening; together, with slot 0 of all agents at origin_ns; or late: it
 * listens, and if no frame arrives, slot 0 began at origin_ns. */
enum { DTSA_BEGINS_LISTENING, DTSA_BEGINS_TOGETHER, DTSA_BEGINS_LATE };

/* Whether slot times move: by the rules, also to those of other agents; slightly, by frames that fit;
 * never. */
enum { DTSA_KEEPS_NOTHING, DTSA_KEEPS_NUMBERS, DTSA_KEEPS_STARTS };

/* The agent of a station. open: decide for a slot that opens; return the length of the frame to send
 * (0: silent), and in chosen the id expected to send. hovers: the agent must stay where it is. */
typedef struct dtsa_station_agent {
    void *context;
    int (*open)(void *context, int64_t slot, int hovers, uint8_t frame[DTSA_DATAGRAM_MAX],
                int *chosen);
    int (*hear)(void *context, int64_t slot, const uint8_t *frame, long length); /* 1: accepted */
    void (*unsent)(void *context);              /* the frame of this slot does not leave */
    void (*close)(void *context, int64_t slot); /* the slot is over */
    void (*restart)(void *context);             /* it forgets all but settings, state and goal */
    int (*leave)(
        void *context); /* 1: its next frame has the leaving flag; 0: it is off at once. May
                                    be called repeatedly */
    int (*on_probation)(void *context); /* policy lease */
} dtsa_station_agent;

/* An agent of libdtsa; context: a dtsa_agent. */
DTSA_API dtsa_station_agent dtsa_station_agent_of(dtsa_agent *agent);

/* What became of a datagram. */
typedef enum dtsa_verdict {
    DTSA_ACCEPTED,
    DTSA_NOT_OURS,
    DTSA_WRONG_LENGTH,
    DTSA_OTHER_SETTINGS,
    DTSA_NO_FRAME,
    DTSA_UNKNOWN_AGENT,
    DTSA_REJECTED, /* its tag is wrong */
    DTSA_REPEATED,
    DTSA_OTHER_TIME,
    DTSA_SAME_ID, /* another agent sends with the own id */
    DTSA_TOO_EARLY,
    DTSA_VERDICT_COUNT
} dtsa_verdict;

/* Whether the station knows the number of the present slot. */
enum {
    DTSA_LISTENING,
    DTSA_ALONE, /* began by its own clock; no frame of these slot times has arrived */
    DTSA_JOINED
};

/* Why the agent hovers. */
enum {
    DTSA_FLIES,
    DTSA_HOVERS_LISTENING, /* does not know yet which slot it is */
    DTSA_HOVERS_NEW,       /* has not sent yet, or not heard a whole round, or is on probation */
    DTSA_HOVERS_SAME_ID,   /* another agent sends with its id */
    DTSA_HOVERS_QUORUM,    /* hears, or is heard by, too few */
    DTSA_HOVER_COUNT
};

typedef struct dtsa_station_status {
    int state;           /* DTSA_LISTENING.. */
    int hovers;          /* DTSA_FLIES.. */
    int64_t slot, first; /* present slot, and the one with which it began; -1 */
    int others, hears, heard_by, both, needed; /* agents, see the quorum */
    int gone;                                  /* a frame with the leaving flag was sent */
    int in_step;             /* agents heard in the own slot times, itself included */
    int64_t flight_error_ns; /* measured flight time of frames minus the link's flight_ns */
    uint32_t slots, sent, unsent, heard, restarts, shifts, alignments;
    uint32_t refused[DTSA_VERDICT_COUNT];
    int64_t timed, off; /* frames near the own slot times; those off by over a quarter of a slot */
} dtsa_station_status;

/* Callbacks for a record; any may be NULL. */
typedef struct dtsa_station_events {
    void *context;
    void (*opened)(void *context, int64_t slot, int64_t start_ns, int64_t now_ns, int is_first);
    void (*restarted)(void *context, int64_t slot); /* it restarts with the next slot */
    void (*sent)(void *context, int64_t slot, const uint8_t *datagram, int length,
                 int64_t now_ns); /* a step gives it to be sent */
    void (*heard)(void *context, int sender, int64_t slot, const uint8_t *datagram, int length,
                  int64_t arrival_ns, int accepted); /* the slot has begun */
    void (*refused)(void *context, int verdict, const uint8_t *datagram, long length,
                    int64_t arrival_ns);
} dtsa_station_events;

/* Contents of a datagram. It names agents that its sender hears, and how much later than expected. */
typedef struct dtsa_named {
    int id; /* 0: none */
    int64_t late_ns;
} dtsa_named;

typedef struct dtsa_datagram {
    int sender;
    uint32_t slot;
    int64_t late_ns;
    dtsa_named names[DTSA_NAMES_MAX];
    const uint8_t *frame; /* in the datagram */
    long frame_length;    /* without the tag */
} dtsa_datagram;

/* Any bytes are allowed; *out is valid if the result is DTSA_ACCEPTED. */
DTSA_API dtsa_verdict dtsa_datagram_read(const dtsa_station_settings *settings, const uint8_t *data,
                                         long length, dtsa_datagram *out);
/* The length of the datagram of a frame; out: room for DTSA_DATAGRAM_MAX bytes. */
DTSA_API int dtsa_datagram_write(const dtsa_station_settings *settings, const uint8_t *frame,
                                 uint32_t slot, int64_t late_ns,
                                 const dtsa_named names[DTSA_NAMES_MAX], uint8_t *out);
/* Whether the sender of a list of `count` names, of at most `most`, hears an agent: 1: yes, -1: no,
 * 0: the list leaves it open. */
DTSA_API int dtsa_names_hear(const dtsa_named *names, int count, int most, int agent);
DTSA_API int dtsa_datagram_length(const dtsa_station_settings *settings);

typedef struct dtsa_station dtsa_station;

/* An agent that did not run for this long restarts, ns: the others may consider it absent. */
DTSA_API int64_t dtsa_station_too_long(const dtsa_station_settings *settings);
DTSA_API size_t dtsa_station_bytes(const dtsa_station_settings *settings);
/* In `memory`, aligned for doubles; NULL: too small, or settings are not usable. Settings are copied
 * but for the key. It listens, or begins where settings say so. */
DTSA_API dtsa_station *dtsa_station_start(void *memory, size_t bytes,
                                          const dtsa_station_settings *settings,
                                          const dtsa_station_agent *agent, int64_t now_ns);
DTSA_API void dtsa_station_observe(dtsa_station *station, const dtsa_station_events *events);
/* Any bytes are allowed. */
DTSA_API dtsa_verdict dtsa_station_receive(dtsa_station *station, const uint8_t *data, long length,
                                           int64_t arrival_ns);
/* Does one step that is due, with the agent's present state. Returns when to call again at the latest
 * (not after now: at once). datagram: room for DTSA_DATAGRAM_MAX bytes, or for the length of one. */
DTSA_API int64_t dtsa_station_step(dtsa_station *station, int64_t now_ns, uint8_t *datagram,
                                   int *length);
/* Whether the port accepted the datagram of the last step. */
DTSA_API void dtsa_station_sent(dtsa_station *station, int64_t now_ns, int accepted);
/* Its next frame announces that it leaves, if the policy's frames can. */
DTSA_API void dtsa_station_leave(dtsa_station *station);
/* Whether the next datagram may make it due earlier; if not, datagrams may wait in the port. */
DTSA_API int dtsa_station_awaits_frame(const dtsa_station *station, int64_t now_ns);
DTSA_API int dtsa_station_hovers(const dtsa_station *station);   /* DTSA_FLIES.. in this slot */
DTSA_API int64_t dtsa_station_slot(const dtsa_station *station); /* -1: none yet */
DTSA_API int64_t dtsa_station_slot_start(const dtsa_station *station, int64_t slot);
/* The longest gap between two frames of an agent that had not left, slots, and the agent's id; 0, 0:
 * none yet. */
DTSA_API int64_t dtsa_station_longest_gap(dtsa_station *station, int *agent);
DTSA_API void dtsa_station_get_status(const dtsa_station *station, dtsa_station_status *status);

#ifdef __cplusplus
}
#endif

#endif
