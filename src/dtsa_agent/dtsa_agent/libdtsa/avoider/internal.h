/* Shared by the avoiders; not for other parts of the kernel. */
#ifndef DTSA_AVOIDER_INTERNAL_H
#define DTSA_AVOIDER_INTERNAL_H

#include "avoider.h"

/* What avoid_vector_level last decided; avoid_command sees to it that it has decided. */
extern int avoid_level_in_force;

/* One question: everything an avoider may look at. */
typedef struct {
    const dtsa_avoid_params *params;
    int n;
    int self;
    const double *position, *velocity, *goal; /* 3 each */
    const double *others_p, *others_v;        /* (3, n) */
    const double *age_s;                      /* (n), or NULL when margins do not count */
    double *scratch;
    double preferred[3]; /* m/s, v_pref, already within v_max */
} avoid_query;

/* Each writes the command before it is limited to v_max. */
void avoid_orca(const avoid_query *query, double command[3]);
void avoid_potential(const avoid_query *query, double command[3]);
void avoid_bvc(const avoid_query *query, double command[3]);

/* Planes of the scratch memory, each long enough for n neighbours, 6 box faces and padding to whole
 * vectors. */
enum { PLANE_X, PLANE_Y, PLANE_Z, PLANE_B, PLANE_BITS, PLANES };

static inline int avoid_plane_length(int n) { return (n + 6 + 3) / 4 * 4 + 4; }

static inline double *avoid_plane(const avoid_query *query, int plane)
{
    return query->scratch + (long)plane * avoid_plane_length(query->n);
}

/* Extra safety distance towards a neighbour whose state is `age` seconds old. */
static inline double avoid_margin(const dtsa_avoid_params *params, double age)
{
    double margin = params->margin_rate * age;
    margin = margin < params->margin_max ? margin : params->margin_max;
    return margin > 0.0 ? margin : 0.0;
}

#endif
