/* Where to fly: collision avoidance in one step for one agent. Pure functions: no allocation, no
 * I/O. Formulas and defaults: docs/reference/settings.md. */
#ifndef DTSA_AVOIDER_H
#define DTSA_AVOIDER_H

#include "rounding.h"

#include "dtsa.h"

/* Scratch memory one caller needs for n agents, in doubles. */
int avoid_scratch_doubles(int n);

/* Commanded velocity of agent `self` (0-based).
 * position, velocity, goal: own true state and goal, 3 each (m, m/s, frame map).
 * others_p, others_v: (3, n) planes, where this agent takes everybody to be now; entry `self` is
 * ignored, and so are positions that are not finite. age_s: (n) seconds since each one's state was
 * sampled, or NULL (no margins). scratch: avoid_scratch_doubles(n) doubles, contents undefined.
 * command: 3, output. */
void avoid_command(int kind, const dtsa_avoid_params *params, int n, int self,
                   const double position[3], const double velocity[3], const double goal[3],
                   const double *others_p, const double *others_v, const double *age_s,
                   double *scratch, double command[3]);

/* Which instructions are used: 0 = those every x86_64 (or other) machine has, 1 = AVX2. Results are
 * the same bits. The best one is chosen at the first call; tests may choose. Returns the level now
 * in force. level < 0 only asks. */
int avoid_vector_level(int level);

#endif
