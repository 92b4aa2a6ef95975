// The operating system's functions: time, delays, tasks, queues, semaphores, software timers.
#include "lab.h"

#include <stdlib.h>
#include <string.h>

#include "semphr.h"

_Static_assert(sizeof(struct Queue) <= sizeof(StaticQueue_t),
               "a queue fits into the memory that an app gives");
_Static_assert(sizeof(struct Timer) <= sizeof(StaticTimer_t),
               "a timer fits into the memory that an app gives");

static Vehicle *own(void)
{
    if (lab.running) return lab.running->vehicle;
    return lab.loading;
}

// ---- time ------------------------------------------------------------------------------------------------------------

TickType_t xTaskGetTickCount(void)
{
    spend(CALL_NS);
    return (TickType_t)(local_ns(own(), own()->free_ns) / TICK_NS);
}

uint64_t usecTimestamp(void)
{
    spend(CALL_NS);
    return (uint64_t)(local_ns(own(), own()->free_ns) / 1000);
}

void peerLabSpend(uint32_t microseconds)
{
    lab.running->began_ns += (int64_t)microseconds * 1000; // it computes, it does not spin
    spend((int64_t)microseconds * 1000);
}

static int64_t until(TickType_t ticks)
{
    return ticks == portMAX_DELAY ? NEVER : tick_end_ns(own(), ticks);
}

void vTaskDelay(TickType_t ticks)
{
    spend(CALL_NS);
    if (ticks)
        wait_for(NULL, false, until(ticks));
    else
        taskYIELD();
}

void taskYIELD(void) { spend(CALL_NS); }

BaseType_t xTaskDelayUntil(TickType_t *previous, TickType_t period)
{
    TickType_t now = xTaskGetTickCount();
    TickType_t due = *previous + period;
    int32_t ahead = (int32_t)(due - now);
    *previous = due;
    if (ahead <= 0) return pdFALSE;
    vTaskDelay((TickType_t)ahead);
    return pdTRUE;
}

void vTaskDelayUntil(TickType_t *previous, TickType_t period)
{
    (void)xTaskDelayUntil(previous, period);
}

// ---- tasks -----------------------------------------------------------------------------------------------------------

BaseType_t xTaskCreate(TaskFunction_t function, const char *name, uint32_t depth, void *argument,
                       UBaseType_t priority, TaskHandle_t *handle)
{
    (void)depth; // this machine's stacks are larger
    spend(CALL_NS);
    Task *task = add_task(own(), function, argument, (int)priority, name);
    if (handle) *handle = task;
    if (task) task->ready_ns = own()->free_ns;
    if (task && lab.running && task->priority > lab.running->priority) {
        lab.horizon_ns = own()->free_ns; // it runs at once
        spend(0);
    }
    return task ? pdPASS : pdFAIL;
}

TaskHandle_t xTaskCreateStatic(TaskFunction_t function, const char *name, uint32_t depth,
                               void *argument, UBaseType_t priority, StackType_t *stack,
                               StaticTask_t *memory)
{
    (void)stack, (void)memory;
    TaskHandle_t task = NULL;
    xTaskCreate(function, name, depth, argument, priority, &task);
    return task;
}

void vTaskDelete(TaskHandle_t task)
{
    spend(CALL_NS);
    if (!task) task = lab.running;
    end_task(task);
    if (task == lab.running) wait_for(NULL, false, NEVER);
}

// ---- queues ----------------------------------------------------------------------------------------------------------

void init_queue(struct Queue *queue, uint8_t *storage, uint32_t length, uint32_t item)
{
    memset(queue, 0, sizeof *queue);
    queue->storage = storage;
    queue->length = length;
    queue->item = item;
}

bool push_item(Vehicle *vehicle, struct Queue *queue, const void *item, bool front)
{
    if (queue->count == queue->length) return false;
    uint32_t place = (queue->first + queue->count) % queue->length;
    if (front) place = queue->first = (queue->first + queue->length - 1) % queue->length;
    if (queue->item) memcpy(queue->storage + place * queue->item, item, queue->item);
    queue->count++;
    wake(vehicle, queue, false);
    return true;
}

static bool peek_item(struct Queue *queue, void *item)
{
    if (!queue->count) return false;
    if (queue->item) memcpy(item, queue->storage + queue->first * queue->item, queue->item);
    return true;
}

bool pop_item(Vehicle *vehicle, struct Queue *queue, void *item)
{
    if (!peek_item(queue, item)) return false;
    queue->first = (queue->first + 1) % queue->length;
    queue->count--;
    wake(vehicle, queue, true);
    return true;
}

QueueHandle_t xQueueCreateStatic(UBaseType_t length, UBaseType_t item_size, uint8_t *storage,
                                 StaticQueue_t *memory)
{
    struct Queue *queue = (struct Queue *)memory;
    init_queue(queue, storage, (uint32_t)length, (uint32_t)item_size);
    return queue;
}

QueueHandle_t xQueueCreate(UBaseType_t length, UBaseType_t item_size)
{
    StaticQueue_t *memory = calloc(1, sizeof *memory + length * item_size);
    return memory ? xQueueCreateStatic(length, item_size, (uint8_t *)(memory + 1), memory) : NULL;
}

static BaseType_t send(QueueHandle_t queue, const void *item, TickType_t ticks, bool front)
{
    spend(CALL_NS);
    if (!queue) misuse("a queue that was not created");
    if (push_item(own(), queue, item, front)) return pdTRUE;
    if (!ticks) return pdFALSE;
    for (int64_t end = until(ticks);;) {
        bool woken = wait_for(queue, true, end);
        if (push_item(own(), queue, item, front)) return pdTRUE;
        if (!woken) return pdFALSE;
    }
}

BaseType_t xQueueSend(QueueHandle_t queue, const void *item, TickType_t ticks)
{
    return send(queue, item, ticks, false);
}

BaseType_t xQueueSendToFront(QueueHandle_t queue, const void *item, TickType_t ticks)
{
    return send(queue, item, ticks, true);
}

BaseType_t xQueueOverwrite(QueueHandle_t queue, const void *item)
{
    spend(CALL_NS);
    if (!queue) misuse("a queue that was not created");
    queue->count = 0;
    return push_item(own(), queue, item, false) ? pdPASS : pdFAIL;
}

static BaseType_t receive(QueueHandle_t queue, void *item, TickType_t ticks, bool keep)
{
    spend(CALL_NS);
    if (!queue) misuse("a queue that was not created");
    if (keep ? peek_item(queue, item) : pop_item(own(), queue, item)) return pdTRUE;
    if (!ticks) return pdFALSE;
    for (int64_t end = until(ticks);;) {
        bool woken = wait_for(queue, false, end);
        if (keep ? peek_item(queue, item) : pop_item(own(), queue, item)) return pdTRUE;
        if (!woken) return pdFALSE;
    }
}

BaseType_t xQueueReceive(QueueHandle_t queue, void *item, TickType_t ticks)
{
    return receive(queue, item, ticks, false);
}

BaseType_t xQueuePeek(QueueHandle_t queue, void *item, TickType_t ticks)
{
    return receive(queue, item, ticks, true);
}

BaseType_t xQueueReset(QueueHandle_t queue)
{
    spend(CALL_NS);
    queue->count = queue->first = 0;
    wake(own(), queue, true);
    return pdPASS;
}

UBaseType_t uxQueueMessagesWaiting(QueueHandle_t queue)
{
    spend(CALL_NS);
    return queue->count;
}

UBaseType_t uxQueueSpacesAvailable(QueueHandle_t queue)
{
    spend(CALL_NS);
    return queue->length - queue->count;
}

// ---- semaphores: queues of items without bytes -----------------------------------------------------------------------

SemaphoreHandle_t xSemaphoreCreateBinaryStatic(StaticSemaphore_t *memory)
{
    return xQueueCreateStatic(1, 0, NULL, memory);
}

SemaphoreHandle_t xSemaphoreCreateMutexStatic(StaticSemaphore_t *memory)
{
    struct Queue *queue = xQueueCreateStatic(1, 0, NULL, memory);
    queue->count = 1;
    return queue;
}

SemaphoreHandle_t xSemaphoreCreateBinary(void) { return xQueueCreate(1, 0); }

SemaphoreHandle_t xSemaphoreCreateCounting(UBaseType_t most, UBaseType_t first)
{
    struct Queue *queue = xQueueCreate(most, 0);
    if (queue) queue->count = (uint32_t)first;
    return queue;
}

SemaphoreHandle_t xSemaphoreCreateMutex(void) { return xSemaphoreCreateCounting(1, 1); }

BaseType_t xSemaphoreTake(SemaphoreHandle_t semaphore, TickType_t ticks)
{
    return receive(semaphore, NULL, ticks, false);
}

BaseType_t xSemaphoreGive(SemaphoreHandle_t semaphore) { return send(semaphore, NULL, 0, false); }

// ---- software timers: one task of a vehicle runs them ----------------------------------------------------------------

void timer_loop(void *argument)
{
    Vehicle *vehicle = argument;
    for (;;) {
        struct Timer *first = NULL;
        for (struct Timer *timer = vehicle->timers; timer; timer = timer->next)
            if (timer->due_ns != NEVER && (!first || timer->due_ns < first->due_ns)) first = timer;
        if (!first || first->due_ns > vehicle->free_ns) {
            pop_item(vehicle, &vehicle->timer_signal, NULL);
            wait_for(&vehicle->timer_signal, false, first ? first->due_ns : NEVER);
            continue;
        }
        first->due_ns = first->repeats ? tick_end_ns(vehicle, first->period) : NEVER;
        first->function(first);
    }
}

TimerHandle_t xTimerCreateStatic(const char *name, TickType_t period, UBaseType_t repeats, void *id,
                                 TimerCallbackFunction_t function, StaticTimer_t *memory)
{
    (void)name;
    struct Timer *timer = (struct Timer *)memory;
    memset(timer, 0, sizeof *timer);
    timer->function = function;
    timer->id = id;
    timer->period = period;
    timer->repeats = repeats != pdFALSE;
    timer->due_ns = NEVER;
    timer->next = own()->timers;
    own()->timers = timer;
    if (!own()->timer_task) own()->timer_task = add_task(own(), timer_loop, own(), 1, "timers");
    return timer;
}

TimerHandle_t xTimerCreate(const char *name, TickType_t period, UBaseType_t repeats, void *id,
                           TimerCallbackFunction_t function)
{
    StaticTimer_t *memory = calloc(1, sizeof *memory);
    return memory ? xTimerCreateStatic(name, period, repeats, id, function, memory) : NULL;
}

static BaseType_t set_timer(TimerHandle_t timer, int64_t due_ns)
{
    timer->due_ns = due_ns;
    push_item(own(), &own()->timer_signal, NULL, false);
    return pdPASS;
}

BaseType_t xTimerStart(TimerHandle_t timer, TickType_t ticks)
{
    (void)ticks;
    spend(CALL_NS);
    return set_timer(timer, tick_end_ns(own(), timer->period));
}

BaseType_t xTimerReset(TimerHandle_t timer, TickType_t ticks) { return xTimerStart(timer, ticks); }

BaseType_t xTimerStop(TimerHandle_t timer, TickType_t ticks)
{
    (void)ticks;
    spend(CALL_NS);
    return set_timer(timer, NEVER);
}

BaseType_t xTimerChangePeriod(TimerHandle_t timer, TickType_t period, TickType_t ticks)
{
    timer->period = period;
    return xTimerStart(timer, ticks);
}

BaseType_t xTimerIsTimerActive(TimerHandle_t timer)
{
    spend(CALL_NS);
    return timer->due_ns != NEVER ? pdTRUE : pdFALSE;
}

void *pvTimerGetTimerID(TimerHandle_t timer) { return timer->id; }
