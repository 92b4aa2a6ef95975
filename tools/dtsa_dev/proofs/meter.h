/* Costs of a call: stack and instructions on a microcontroller, nothing elsewhere. */
#ifndef METER_H
#define METER_H

enum { METER_SLOT, METER_COMMAND, METER_HEAR, METER_END, METERS };

#ifdef METERED
void meter_reset(void);
void meter_begin(void);
void meter_end(int which);
void meter_print(void);
#else
#include <stdio.h>
static inline void meter_reset(void) {}
static inline void meter_begin(void) {}
static inline void meter_end(int which) { (void)which; }
static inline void meter_print(void) { putchar('\n'); }
#endif

#endif
