/* Goals that some agents have one after the other: how far each is with the scenario's plan. */
#ifndef DTSA_COURSE_H
#define DTSA_COURSE_H

#include <stdint.h>

typedef struct course {
    int n, count, goal_count; /* agents of the plan, agents here, goals of each */
    double r_min;             /* m, closer than this an agent has arrived */

    /* Borrowed: the plan. */
    int32_t *local;         /* (count) index of each agent here */
    double *start, *goals;  /* (3, n), (goal_count, 3, n) m */
    int64_t *begin, *pause; /* (n) first slot of its flight; slots that it rests at a goal */
    uint8_t *moving;        /* (n) */
    /* Borrowed: the state. */
    int64_t *leg;     /* (count) index of the present goal, -1: waits for its first slot */
    int64_t *since;   /* (count) slot of arrival at the present goal, -1: under way */
    int64_t *changed; /* (count) slot in which that became its goal, -1: none yet */
    double *goal;     /* (3, count) m, where each flies to now */
} course;

/* A slot begins; position (3, count) m. -> whether any goal has changed. */
int course_advance(course *c, int64_t slot, const double *position);
int course_is_final(const course *c, int l); /* no further goal is scheduled */

#endif
