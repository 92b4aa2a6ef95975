// The laboratory's engine: apps of many vehicles as tasks in virtual time, one at a time.
//
// A task runs until it waits for something, until its time reaches that of what happens next elsewhere, or until it asks
// for what the laboratory's owner decides. Each call of the firmware takes a microsecond, so a loop that only looks at
// the time ends. Nothing here reads a clock of this machine: the same calls give the same run.
#pragma once

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <ucontext.h>

#include "log.h"
#include "queue.h"
#include "radiolink.h"
#include "task.h"
#include "timers.h"

#define NEVER INT64_MAX
#define CALL_NS 1000
#define TICK_NS 1000000
#define MAX_TASKS 12
#define MAX_VARIABLES 512
#define MAX_INBOX 8
#define EVENT_BYTES 1024
#define APP_PRIORITY 0
#define STACK_BYTES (256 * 1024)

// What the engine tells its owner. Values: peer_lab/engine.py.
enum {
    EVENT_NONE,
    EVENT_SEND,
    EVENT_HEARD,
    EVENT_COMMAND,
    EVENT_PRINT,
    EVENT_APP_CHANNEL,
    EVENT_ENDED,
    EVENT_SPINS,
    EVENT_ASSERT,
    EVENT_MISUSE,
    EVENT_RECORD
};

// Commands that the owner answers. Values: peer_lab/engine.py.
enum {
    COMMAND_SETPOINT,
    COMMAND_RELAX,
    COMMAND_TAKEOFF,
    COMMAND_LAND,
    COMMAND_STOP,
    COMMAND_GO_TO,
    COMMAND_ARM,
    COMMAND_RECOVER,
    COMMAND_PARAMETER,
    COMMAND_DISABLE
};

typedef struct {
    int32_t kind, vehicle, code, size;
    int64_t time_ns;  // when
    int64_t other_ns; // EVENT_SEND: when the radio has it
    int32_t answer;   // EVENT_COMMAND: written by the owner before it goes on
    uint8_t data[EVENT_BYTES];
} Event;

typedef struct Vehicle Vehicle;

struct Queue {
    uint8_t *storage;
    uint32_t length, item, count, first;
    bool owned;
};

struct Task {
    ucontext_t context;
    Vehicle *vehicle;
    void *stack;
    size_t stack_bytes;
    TaskFunction_t function;
    void *argument;
    int priority;
    int64_t ready_ns;    // when it goes on; NEVER: only when it is woken
    int64_t began_ns;    // when it last began to run after it had waited
    int64_t ran;         // number of its last turn
    struct Queue *waits; // for an item, or for room
    bool wants_room;
    bool used;
    char name[24];
};
typedef struct Task Task;

struct Timer {
    TimerCallbackFunction_t function;
    void *id;
    TickType_t period;
    int64_t due_ns; // NEVER: it does not run
    bool repeats, owned;
    struct Timer *next;
};

// What a system task of the firmware does for an app.
typedef struct {
    void (*callback)(void);
    P2PPacket packet;
} Job;

typedef struct {
    int type;
    char name[64]; // group.name
    void *address;
    void (*callback)(void);
} Variable;

struct Vehicle {
    int number; // from 0
    bool on;
    void *library;
    int64_t boot_ns, drift_ppb, clock_ns;
    int64_t free_ns; // its processor is free again
    int64_t line_ns; // the line to the radio is free again
    Task tasks[MAX_TASKS];
    int task_count; // places that were ever used
    Variable logs[MAX_VARIABLES], parameters[MAX_VARIABLES];
    int log_count, parameter_count;
    double *log_values;       // values of the firmware's own log variables
    double *parameter_values; // values of the firmware's own parameters
    P2PCallback callback;
    struct Queue radio_jobs, parameter_jobs, app_channel;
    uint8_t radio_storage[MAX_INBOX * sizeof(Job)], parameter_storage[MAX_INBOX * sizeof(Job)];
    uint8_t app_storage[10 * 32];
    bool app_overflow;
    struct Timer *timers;
    Task *timer_task;
    struct Queue timer_signal;
    uint64_t address;
    int channel, speed;
};

typedef struct {
    int count, log_name_count, parameter_name_count;
    char (*log_names)[64];       // the firmware's own log variables
    char (*parameter_names)[64]; // the firmware's own parameters
    Vehicle *vehicles;
    int64_t now_ns, horizon_ns, until_ns, turns, spin_ns;
    int64_t line_fixed_ns, line_byte_ns;
    Task *running, *asked;
    Vehicle *loading; // whose app registers its variables
    ucontext_t owner;
    Event event;
    volatile uint64_t calls;
} Lab;

extern Lab lab;

// Time.
int64_t local_ns(const Vehicle *vehicle, int64_t time_ns);
int64_t true_ns(const Vehicle *vehicle, int64_t local);
int64_t tick_end_ns(const Vehicle *vehicle, TickType_t ticks); // when so many ticks are over

// Tasks.
Task *add_task(Vehicle *vehicle, TaskFunction_t function, void *argument, int priority,
               const char *name);
void end_task(Task *task);
void spend(int64_t ns); // the running task uses its processor
bool wait_for(struct Queue *queue, bool wants_room, int64_t until_ns); // false: time is up
void wake(Vehicle *vehicle, struct Queue *queue, bool room); // wakes the first of those that wait
void yield_event(void);                                      // hands `lab.event` to the owner
void misuse(const char *what) __attribute__((noreturn));
void watch_for_crashes(void);

// Queues without waiting.
void init_queue(struct Queue *queue, uint8_t *storage, uint32_t length, uint32_t item);
bool push_item(Vehicle *vehicle, struct Queue *queue, const void *item, bool front);
bool pop_item(Vehicle *vehicle, struct Queue *queue, void *item);

void timer_loop(void *argument);
double variable_value(const Variable *variable);
void set_variable(Vehicle *vehicle, Variable *variable, double value);
