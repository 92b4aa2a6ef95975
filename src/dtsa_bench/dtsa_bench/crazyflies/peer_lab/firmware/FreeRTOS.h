// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "cfassert.h"

typedef long BaseType_t;
typedef unsigned long UBaseType_t;
typedef uint32_t TickType_t;
typedef uint32_t StackType_t;

// Room for what the laboratory keeps of a queue, a task or a timer whose memory the app gives.
typedef struct {
    uint64_t room[8];
} StaticQueue_t;
typedef StaticQueue_t StaticSemaphore_t;
typedef struct {
    uint64_t room[8];
} StaticTask_t;
typedef struct {
    uint64_t room[8];
} StaticTimer_t;

#define pdFALSE ((BaseType_t)0)
#define pdTRUE ((BaseType_t)1)
#define pdFAIL pdFALSE
#define pdPASS pdTRUE
#define errQUEUE_EMPTY pdFALSE
#define errQUEUE_FULL pdFALSE
#define portMAX_DELAY ((TickType_t)0xffffffffu)
#define configTICK_RATE_HZ 1000
#define configMINIMAL_STACK_SIZE 150
#define configASSERT(condition) ASSERT(condition)
#define portTICK_PERIOD_MS 1
#define pdMS_TO_TICKS(ms) ((TickType_t)(ms))
#define M2T(ms) ((TickType_t)(ms))
#define T2M(ticks) ((TickType_t)(ticks))
#define F2T(hz) ((TickType_t)(configTICK_RATE_HZ / (hz)))
