#include "course.h"

#include <math.h>

int course_is_final(const course *c, int l)
{
    return !c->moving[c->local[l]] || c->leg[l] == c->goal_count - 1;
}

static int arrived(const course *c, int l, const double *position)
{
    double squared = 0.0;
    for (int i = 0; i < 3; i++) {
        const double away = position[i * c->count + l] - c->goal[i * c->count + l];
        squared += away * away;
    }
    return sqrt(squared) <= c->r_min;
}

int course_advance(course *c, int64_t slot, const double *position)
{
    int any = 0;
    for (int l = 0; l < c->count; l++) {
        const int k = c->local[l];
        int onward = c->leg[l] < 0 && c->begin[k] <= slot;
        if (c->leg[l] >= 0 && c->leg[l] < c->goal_count - 1) {
            if (c->since[l] < 0 && arrived(c, l, position)) c->since[l] = slot;
            onward = c->since[l] >= 0 && slot - c->since[l] >= c->pause[k];
        }
        if (!onward) continue;
        any = 1;
        c->leg[l]++;
        c->since[l] = -1;
        c->changed[l] = slot;
        for (int i = 0; i < 3; i++)
            c->goal[i * c->count + l] = c->goals[(c->leg[l] * 3 + i) * c->n + k];
    }
    return any;
}
