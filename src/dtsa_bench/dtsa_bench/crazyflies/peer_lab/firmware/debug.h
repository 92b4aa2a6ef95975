// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

// Formats are read as on a Cortex-M4: `%lu` takes 32 bits.
void labPrint(const char *format, ...);

#ifdef DEBUG_MODULE
#define DEBUG_FMT(format) DEBUG_MODULE ": " format
#else
#define DEBUG_FMT(format) format
#endif

#define DEBUG_PRINT(format, ...) labPrint(DEBUG_FMT(format), ##__VA_ARGS__)
#define DEBUG_PRINT_OS(format, ...) labPrint(DEBUG_FMT(format), ##__VA_ARGS__)
