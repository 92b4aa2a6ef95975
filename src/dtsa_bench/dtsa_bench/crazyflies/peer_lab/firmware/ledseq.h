// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include <stdbool.h>

// Lights: nothing is shown.
typedef struct {
    bool value;
    int action;
} ledseqStep_t;
typedef struct {
    const ledseqStep_t *sequence;
    int led;
} ledseqContext_t;

#define LEDSEQ_WAITMS(ms) (ms)
#define LEDSEQ_STOP (-1)
#define LEDSEQ_LOOP (-2)

static inline void ledseqRegisterSequence(ledseqContext_t *context) { (void)context; }
static inline bool ledseqRun(ledseqContext_t *context) { return context != 0; }
static inline bool ledseqRunBlocking(ledseqContext_t *context) { return context != 0; }
static inline bool ledseqStop(ledseqContext_t *context) { return context != 0; }
