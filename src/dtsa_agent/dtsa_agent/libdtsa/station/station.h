/* Internals of a station: datagram.c reads and writes datagrams, clock.c estimates when slots begin,
 * delay.c how long frames are under way, contacts.c tracks which agents hear each other, station.c is
 * the loop. The same in plain Python: core/reference/station.py. */
#ifndef DTSA_STATION_INTERNAL_H
#define DTSA_STATION_INTERNAL_H

#include "dtsa_station.h"
#include "frame.h"

enum { SENT_HISTORY_LENGTH = 16, RECEPTIONS = 9 };

enum { KNOWS_OFFSET = 1, KNOWS_REPORT = 2, KNOWS_SUM = 4 };

/* Another agent. */
typedef struct peer {
    int64_t heard_ns,
        origin_ns;     /* its last frame: arrival (INT64_MIN: none), start of its slot 0 */
    int64_t near_ns;   /* arrival of its last frame that fits the own slots; INT64_MIN: none */
    int64_t last_slot; /* of that frame, as on the air; -1: none */
    int64_t offset_ns, report_ns, reported_ns, sum_ns; /* see delay.c */
    int32_t unnamed;                                   /* its datagrams since it named this agent */
    uint32_t heard_slot;
    int8_t hears_us;   /* 1: yes, -1: no, 0: unknown */
    uint8_t was_heard; /* since this agent restarted; last in heard_slot (low bits) */
    uint8_t steady;    /* its last two frames show the same time */
    uint8_t known, left;
    uint8_t resting; /* it sends in main anchors alone: it rests, or is on probation */
} peer;

typedef struct early_frame {
    int64_t slot, arrival_ns;
    int sender;
    long length;
    uint8_t *datagram;
} early_frame;

struct dtsa_station {
    dtsa_station_settings settings;
    dtsa_station_agent agent;
    dtsa_station_events events;
    int datagram_length, head_length; /* bytes; of these before the frame */
    int64_t moving_ns, resting_ns, patience_ns, round_ns;
    int64_t lead_ns, latest_lead_ns, latest_send_ns, too_long_ns;

    /* Slot times. */
    int state;
    int64_t origin_ns, deadline_ns; /* start of slot 0; when listening ends */
    int64_t offsets[RECEPTIONS];    /* of frames since the slots were aligned last, ascending */
    int offset_count;
    int64_t heard_ns,
        in_step_ns; /* last frame of others, and with the own slot times; or the start */
    int64_t earlier_since,
        earlier_ns; /* first and last frame of earlier slot times; INT64_MIN: none */

    /* Flight times of frames. */
    int64_t flight_error_ns;
    int64_t *sums; /* (agents) of all pairs, ascending */
    int sum_count, name_turn;

    peer *peers;           /* (agents) */
    int64_t same_id_until; /* another agent sent with the own id; INT64_MIN: none */
    int64_t refused_since; /* the port refuses datagrams; INT64_MIN: it accepts them */

    /* The loop. */
    int64_t slot, first;
    int running, awaits, newcomer, has_sent, hovers, leaving, gone;
    int frame_length; /* of the frame to send in this slot, 0: none */
    uint8_t *frame;
    early_frame *early;
    int early_count;
    uint64_t sent_hashes[SENT_HISTORY_LENGTH];
    unsigned sent_index;
    int32_t longest_gap; /* slots, between two frames of the agent longest_of */
    int longest_of;
    dtsa_station_status counts;
};

static inline int64_t larger(int64_t a, int64_t b) { return a > b ? a : b; }

static inline int64_t smaller(int64_t a, int64_t b) { return a < b ? a : b; }

static inline int64_t limited(int64_t value, int64_t limit)
{
    return value < -limit ? -limit : value > limit ? limit : value;
}

static inline int64_t floor_div(int64_t a, int64_t b) /* b > 0 */ { return a / b - (a % b < 0); }

/* datagram.c */
int datagram_head(const dtsa_link *link); /* bytes before the frame */
/* Continues a hash, which begins with HASH_START. */
static const uint64_t HASH_START = 0xcbf29ce484222325ULL, HASH_PRIME = 0x100000001b3ULL;
uint64_t datagram_hash(uint64_t hash, const uint8_t *data, long length);

/* clock.c */
enum { IN_STEP, SHIFTED, RESTARTED, OTHER };
/* A frame of peer k shows that slot 0 began at origin_ns. */
int clock_hear(dtsa_station *s, int k, int64_t origin_ns, int64_t arrival_ns);
int64_t clock_slot(const dtsa_station *s, int64_t now);
int64_t clock_unwrap(const dtsa_station *s, uint32_t slot, int64_t now);
int64_t clock_apart(const dtsa_station *s, int64_t a_ns, int64_t b_ns); /* a - b, of two origins */
int clock_in_step(const dtsa_station *s,
                  int64_t now); /* agents in the own slot times, with itself */

/* delay.c */
void delay_hear(dtsa_station *s, const dtsa_datagram *d, int64_t offset_ns, int64_t arrival);
void delay_forget_report(dtsa_station *s, peer *p);
void delay_shift(dtsa_station *s, int64_t by_ns);
void delay_reset(dtsa_station *s);
void delay_name(dtsa_station *s, int64_t now, dtsa_named out[DTSA_NAMES_MAX]);

/* contacts.c */
void contacts_hear(dtsa_station *s, const dtsa_datagram *d);
int contacts_is_recent(const dtsa_station *s, const peer *p, int64_t now);
int contacts_hears(const dtsa_station *s, const peer *p, int64_t now);
int contacts_have_quorum(dtsa_station *s, int64_t now); /* fills the counts */

#endif
