// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

void labAssertFailed(const char *file, int line) __attribute__((noreturn));

#define ASSERT_FAILED() labAssertFailed(__FILE__, __LINE__)
#define ASSERT(condition)                                                                          \
    do {                                                                                           \
        if (!(condition)) ASSERT_FAILED();                                                         \
    } while (0)
