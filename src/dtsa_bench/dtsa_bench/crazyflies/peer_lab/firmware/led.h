// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include <stdbool.h>

// Lights: nothing is shown.
typedef enum { LED_BLUE_L, LED_GREEN_L, LED_RED_L, LED_GREEN_R, LED_RED_R, LED_BLUE_NRF } led_t;
static inline void ledSet(led_t led, bool on)
{
    (void)led;
    (void)on;
}
static inline void ledSetAll(void) {}
static inline void ledClearAll(void) {}
