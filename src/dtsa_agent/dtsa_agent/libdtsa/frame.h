/* The radio frame: the only codec. Layout: docs/reference/protocol.md. */
#ifndef DTSA_FRAME_H
#define DTSA_FRAME_H

#include "rounding.h"

#include "dtsa.h"

enum { FRAME_VERSION = 1, FRAME_LEAVES = 255 }; /* in byte 2 of extended frames */
enum {
    SECTIONS = 3,
    SECTION_BYTES = 11,
    EXTENDED_HEAD = 23,
    EXTENDED_LENGTH = EXTENDED_HEAD + SECTIONS * SECTION_BYTES
};
enum { RELAY_IDS = 8, RELAY_REACH = 24, GOSSIP_AGE_MAX = 127, LEASE_ROOM = 2 * SECTION_BYTES };
enum { FAR_BYTES = SECTION_BYTES - 1, FAR_REACH = RELAY_REACH + 8 * FAR_BYTES };
enum {
    LEASE_NONE = 0,  /* a turn is its owner's */
    LEASE_OPEN = 255 /* a turn is whoever's has just woken or joined */
};
enum { FRAME_OK = 0, FRAME_BAD_LENGTH = -1, FRAME_BAD_HEADER = -2, FRAME_BAD_FIELD = -3 };

typedef struct dtsa_frame {
    int32_t profile;
    int32_t sender;    /* id, 1..65535 */
    uint32_t slot;     /* slot the state was sampled in */
    int32_t c_r;       /* transmission parameter (eq:remaining_t_slots), 0..255 */
    double p[3], v[3]; /* m, m/s, frame map */
    double c[3];       /* m/s, commanded velocity; zero without intent */
} dtsa_frame;

typedef struct gossip_entry {
    int32_t id, age, c_r, reserved; /* 1..254; slots since it was sampled, 1..127; 0 or 1 */
    double p[3], v[3]; /* m, m/s, frame map; 4 mm (2 position steps), 2 cm/s on the air */
} gossip_entry;

typedef struct extended_frame {
    dtsa_frame own;
    int32_t c_s; /* consecutive ids before the sender that it thinks dead, 0..253 */
    int32_t leaving, probation;
    int32_t gossip_count, lease_count;
    uint32_t relay_mask; /* bit d - 1: turn slot + d is leased */
    gossip_entry gossip[SECTIONS];
    uint8_t leases[SECTIONS * SECTION_BYTES];
    uint8_t relay_ids[RELAY_IDS];
    uint8_t far_id; /* lessee of the turns handed on beyond the relay's reach, 0: none */
    uint8_t far_mask[FAR_BYTES]; /* bit b: turn slot + RELAY_REACH + 1 + b is handed on to it */
} extended_frame;

/* What a frame says of its sender. Extended frames alone say that it leaves or is on probation. */
typedef struct frame_condition {
    int leaves, rests, on_probation;
} frame_condition;

/* ---- frame.c ---- */

int frame_length(int profile); /* bytes, 0 for an unknown profile */
/* position_step: m, agreed on by the whole swarm; the largest coordinate that fits is 32767 steps.
 * -> length, 0 if a field cannot be said. */
int frame_encode(const dtsa_frame *frame, double position_step, uint8_t *out);
int frame_decode(const uint8_t *data, long length, double position_step, dtsa_frame *frame);
/* Of any frame with a header, unchecked. */
frame_condition frame_condition_of(const uint8_t *data);
/* Quantised fields, shared by all profiles; saturate, never wrap. */
int64_t quantise(double value, double step, int bits);

/* ---- frame_extended.c ---- */

/* -> length, 0 if a field cannot be said. */
int extended_encode(const extended_frame *frame, double position_step, uint8_t *out);
int extended_decode(const uint8_t *data, long length, double position_step, extended_frame *frame);
/* Whether gossip can say a state without saturating. */
int gossip_fits(const double p[3], const double v[3], double position_step);

#endif
