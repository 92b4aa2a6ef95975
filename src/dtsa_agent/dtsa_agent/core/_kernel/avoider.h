/* Where to fly: collision avoidance in one step for one agent. Pure functions: no allocation, no state, no I/O.
 * Formulas and defaults: docs/avoiders.md. */
#ifndef DTSA_AVOIDER_H
#define DTSA_AVOIDER_H

#include <stdint.h>

enum { AVOID_ORCA = 0, AVOID_POTENTIAL = 1, AVOID_BVC = 2, AVOID_NONE = 3, AVOID_KINDS = 4 };

/* Parameters of all avoiders; which fields count depends on the kind. All are doubles, in this order (module_avoider.c
 * reads them as a list). */
typedef struct {
    double v_max;      /* m/s, largest commanded speed */
    double gain;       /* 1/s, K_P: v_pref = min(v_max, gain * distance) towards the goal */
    double radius;     /* m, orca: R_c, pair radius; bvc: radius of one agent */
    double horizon;    /* s, orca: T, look-ahead; bvc: the cell is cut off at horizon * v_max */
    double softness;   /* 1, orca: rho, weight of a violated half-plane */
    double bias;       /* 1, orca: beta, right-hand bias */
    double period;     /* s, orca: T_s, time in which an existing overlap is resolved (0.2) */
    double influence;  /* m, potential: r_inf */
    double strength;   /* m^2/s, potential: k */
    double core;       /* m, potential: d_c */
    double tangential; /* 1, potential: share of the sideways force */
    double
        margin_rate; /* m/s, how fast the safety margin of a neighbour grows with the age of its state (0: not at all) */
    double margin_max; /* m, largest such margin */
    double sidestep;   /* m, bvc: nearer than this to its cell's wall an agent steps to its right */
    double stretch_z;  /* 1, bvc: height of an agent's ellipsoid over its width (downwash) */
} avoid_params;

#define AVOID_PARAM_COUNT ((int)(sizeof(avoid_params) / sizeof(double)))

/* Scratch memory one caller needs for n agents, in doubles. */
int avoid_scratch_doubles(int n);

/* Commanded velocity of agent `self` (0-based).
 * position, velocity, goal: own true state and goal, 3 each (m, m/s, frame map).
 * others_p, others_v: (3, n) planes, what this agent believes about everybody now; entry `self` is ignored, and so is
 * whoever's believed position is not finite.
 * age_s: (n) seconds since each one's state was sampled, or NULL (no margins).
 * scratch: avoid_scratch_doubles(n) doubles, contents undefined.
 * command: 3, output. */
void avoid_command(int kind, const avoid_params *params, int n, int self, const double position[3],
                   const double velocity[3], const double goal[3], const double *others_p,
                   const double *others_v, const double *age_s, double *scratch, double command[3]);

/* Which instructions are used: 0 = those every x86_64 (or other) machine has, 1 = AVX2. Results are the same bits. The
 * best one is chosen at the first call; tests may choose. Returns the level now in force. level < 0 only asks. */
int avoid_vector_level(int level);

#endif
