// Own declarations of functions that the documentation of the Crazyflie firmware names: apps are compiled against them
// for this machine. No text of the firmware is in here.
#pragma once

#include "FreeRTOS.h"

typedef struct Task *TaskHandle_t;
typedef TaskHandle_t xTaskHandle;
typedef void (*TaskFunction_t)(void *);

TickType_t xTaskGetTickCount(void);
void vTaskDelay(TickType_t ticks);
void vTaskDelayUntil(TickType_t *previous, TickType_t period);
BaseType_t xTaskDelayUntil(TickType_t *previous, TickType_t period);
BaseType_t xTaskCreate(TaskFunction_t function, const char *name, uint32_t depth, void *argument,
                       UBaseType_t priority, TaskHandle_t *handle);
TaskHandle_t xTaskCreateStatic(TaskFunction_t function, const char *name, uint32_t depth,
                               void *argument, UBaseType_t priority, StackType_t *stack,
                               StaticTask_t *memory);
void vTaskDelete(TaskHandle_t task);
void taskYIELD(void);

// One task of a vehicle runs at a time, and is interrupted only where it calls the firmware.
#define taskENTER_CRITICAL() ((void)0)
#define taskEXIT_CRITICAL() ((void)0)
