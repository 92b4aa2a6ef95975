/* Whether an agent on board may steer its vehicle: pure rules, told what there is to see.
 *
 *   OFF --- the ground has enabled it, all is well ---> FLY <--- all is well again ---> HOVER
 *    ^                                                   |                               |
 *    +--- the ground commands, or it may not fly         +------------> LAND <-----------+
 *
 * LAND stays until the vehicle is down and the ground enables it anew. The ground wins always: what
 * it commands ends all steering, until it enables it anew. */
#ifndef DTSA_SAFETY_H
#define DTSA_SAFETY_H

#include <stdint.h>

typedef enum safety_mode { SAFETY_OFF, SAFETY_FLY, SAFETY_HOVER, SAFETY_LAND } safety_mode;

/* Why it is not FLY, the most urgent first. */
typedef enum safety_reason {
    SAFETY_WELL,
    SAFETY_DISABLED,   /* the ground has not enabled it, or has disabled it */
    SAFETY_GROUND,     /* the ground commands the vehicle itself */
    SAFETY_CANNOT_FLY, /* says the supervisor */
    SAFETY_ORDERED,    /* the ground says: land */
    SAFETY_BATTERY,
    SAFETY_OUTSIDE,  /* of its box, or it does not know where it is */
    SAFETY_UNHEARD,  /* no frame for too long */
    SAFETY_OLD_NEWS, /* the state of some agent is too old */
    SAFETY_NEWCOMER, /* the others do not know it yet */
    SAFETY_REASONS
} safety_reason;

typedef struct safety_settings {
    float news_s;          /* oldest state of a moving agent with which it flies */
    float rests_s;         /* ... of an agent that hovers, and sends seldom */
    float unheard_s;       /* without any frame it hovers after this time */
    float land_s;          /* it has hovered for so long: it lands */
    float well_s;          /* all has to be well for so long before it flies again */
    float battery_v;       /* it lands below this voltage, */
    float sag_s;           /* if that lasts so long: motors that pull hard lower it for a moment */
    float low[3], high[3]; /* m, frame map: the box */
} safety_settings;

typedef struct safety_view {
    int enabled, ordered; /* by the ground: may steer; has to land */
    int ground;           /* the ground commands the vehicle itself */
    int can_fly, in_air;  /* says the supervisor */
    int newcomer;
    float battery_v, position[3];
    float oldest_s;  /* age of the oldest state of those that move; negative: one is missing */
    float rests_s;   /* ... of those that rest */
    float unheard_s; /* since any frame was heard; negative: never */
} safety_view;

typedef struct safety {
    safety_mode mode;
    safety_reason reason;
    float since_s; /* for how long it has been in this mode */
    float well_s, sagged_s, outside_s;
    int refused; /* the ground has to disable it before it may enable it again */
} safety;

void safety_reset(safety *s);
/* What to do now; `elapsed_s` since the last call. */
safety_mode safety_step(safety *s, const safety_settings *settings, const safety_view *view,
                        float elapsed_s);

#endif
