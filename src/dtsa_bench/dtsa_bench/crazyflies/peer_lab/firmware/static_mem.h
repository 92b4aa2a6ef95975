// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include "queue.h"
#include "semphr.h"
#include "task.h"

#define NO_DMA_CCM_SAFE_ZERO_INIT
#define FORCE_CCM_ZERO_INIT

#define STATIC_MEM_QUEUE_ALLOC(NAME, LENGTH, ITEM_SIZE)                                            \
    enum { NAME##QueueLength = (LENGTH), NAME##QueueItem = (ITEM_SIZE) };                          \
    static uint8_t NAME##QueueStorage[(LENGTH) * (ITEM_SIZE)];                                     \
    static StaticQueue_t NAME##QueueMemory;
#define STATIC_MEM_QUEUE_CREATE(NAME)                                                              \
    xQueueCreateStatic(NAME##QueueLength, NAME##QueueItem, NAME##QueueStorage, &NAME##QueueMemory)

#define STATIC_MEM_TASK_ALLOC(NAME, DEPTH)                                                         \
    enum { NAME##TaskDepth = (DEPTH) };                                                            \
    static StackType_t NAME##TaskStack[DEPTH];                                                     \
    static StaticTask_t NAME##TaskMemory;
#define STATIC_MEM_TASK_ALLOC_STACK_NO_DMA_CCM_SAFE(NAME, DEPTH) STATIC_MEM_TASK_ALLOC(NAME, DEPTH)
#define STATIC_MEM_TASK_CREATE(NAME, FUNCTION, TASK_NAME, ARGUMENT, PRIORITY)                      \
    xTaskCreateStatic((FUNCTION), (TASK_NAME), NAME##TaskDepth, (ARGUMENT), (PRIORITY),            \
                      NAME##TaskStack, &NAME##TaskMemory)
