// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include <stdint.h>

// What only the laboratory has; `PEER_LAB` is defined when an app is compiled for it.

// The app computes for so long before it goes on: a Cortex-M4 is slower than this machine.
void peerLabSpend(uint32_t microseconds);

// Hands something over to those that look on, at most 1024 bytes: what it decided, for a bag. It takes no time.
void peerLabRecord(const void *data, uint32_t size);
