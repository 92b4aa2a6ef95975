// Tasks in virtual time: whose turn it is, and what a turn ends with.
#define _GNU_SOURCE
#include "lab.h"

#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

Lab lab;

#define PAGE 4096
// A task may run so far ahead of other vehicles: nothing that they do reaches it sooner, by the line to a radio.
#define AHEAD_NS 20000

int64_t local_ns(const Vehicle *vehicle, int64_t time_ns)
{
    int64_t up = time_ns - vehicle->boot_ns;
    return vehicle->clock_ns + up + (int64_t)((__int128)up * vehicle->drift_ppb / 1000000000);
}

int64_t true_ns(const Vehicle *vehicle, int64_t local)
{
    __int128 scaled = (__int128)(local - vehicle->clock_ns) * 1000000000;
    int64_t time = vehicle->boot_ns + (int64_t)(scaled / (1000000000 + vehicle->drift_ppb));
    while (local_ns(vehicle, time) < local) time++;
    while (local_ns(vehicle, time - 1) >= local) time--;
    return time;
}

int64_t tick_end_ns(const Vehicle *vehicle, TickType_t ticks)
{
    int64_t tick = local_ns(vehicle, vehicle->free_ns) / TICK_NS;
    return true_ns(vehicle, (tick + ticks) * TICK_NS);
}

static void to_owner(Task *task) { swapcontext(&task->context, &lab.owner); }

static void run_task(unsigned low, unsigned high)
{
    Task *task = (Task *)(((uintptr_t)high << 32) | low);
    task->function(task->argument);
    lab.event.kind = EVENT_ENDED;
    snprintf((char *)lab.event.data, sizeof lab.event.data, "%s", task->name);
    lab.event.size = (int)strlen((char *)lab.event.data);
    task->ready_ns = NEVER;
    task->waits = NULL;
    yield_event();
    for (;;) { // a task that returns is over
        task->ready_ns = NEVER;
        to_owner(task);
    }
}

Task *add_task(Vehicle *vehicle, TaskFunction_t function, void *argument, int priority,
               const char *name)
{
    Task *task = vehicle->tasks;
    while (task < vehicle->tasks + MAX_TASKS && task->used) task++;
    if (task == vehicle->tasks + MAX_TASKS) return NULL;
    if (task - vehicle->tasks >= vehicle->task_count) vehicle->task_count++;
    memset(task, 0, sizeof *task);
    task->stack_bytes = STACK_BYTES + PAGE;
    task->stack =
        mmap(NULL, task->stack_bytes, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (task->stack == MAP_FAILED) return NULL;
    mprotect(task->stack, PAGE, PROT_NONE); // what outgrows the stack is caught
    task->vehicle = vehicle;
    task->function = function;
    task->argument = argument;
    task->priority = priority;
    task->used = true;
    task->ready_ns = task->began_ns = vehicle->free_ns;
    snprintf(task->name, sizeof task->name, "%s", name ? name : "");
    getcontext(&task->context);
    task->context.uc_stack.ss_sp = task->stack;
    task->context.uc_stack.ss_size = task->stack_bytes;
    task->context.uc_link = NULL;
    uintptr_t self = (uintptr_t)task;
    makecontext(&task->context, (void (*)(void))run_task, 2, (unsigned)self,
                (unsigned)(self >> 32));
    return task;
}

void end_task(Task *task)
{
    if (!task->used) return;
    if (task != lab.running) munmap(task->stack, task->stack_bytes);
    task->used = false;
}

// The task whose turn comes first on a vehicle, and when.
static Task *candidate(Vehicle *vehicle, int64_t *when)
{
    int64_t first = NEVER;
    for (Task *task = vehicle->tasks; task < vehicle->tasks + vehicle->task_count; task++)
        if (task->used && task->ready_ns < first) first = task->ready_ns;
    if (first == NEVER) return NULL;
    if (first < vehicle->free_ns) first = vehicle->free_ns;
    Task *best = NULL;
    for (Task *task = vehicle->tasks; task < vehicle->tasks + vehicle->task_count; task++) {
        if (!task->used || task->ready_ns > first) continue;
        if (!best || task->priority > best->priority ||
            (task->priority == best->priority && task->ran < best->ran))
            best = task;
    }
    *when = first;
    return best;
}

static Task *next_task(int64_t *when)
{
    Task *best = NULL;
    *when = NEVER;
    for (int k = 0; k < lab.count; k++) {
        int64_t time;
        Task *task = lab.vehicles[k].on ? candidate(&lab.vehicles[k], &time) : NULL;
        // Of those at one time the one comes first whose last turn is longest ago.
        if (task && (time < *when || (time == *when && task->ran < best->ran)))
            best = task, *when = time;
    }
    return best;
}

// When something happens that may not wait for the running task.
static int64_t horizon(const Task *running)
{
    int64_t first = lab.until_ns;
    for (int k = 0; k < lab.count; k++) {
        Vehicle *vehicle = &lab.vehicles[k];
        if (!vehicle->on) continue;
        if (vehicle != running->vehicle) {
            int64_t time;
            if (candidate(vehicle, &time) && time + AHEAD_NS < first) first = time + AHEAD_NS;
            continue;
        }
        for (Task *task = vehicle->tasks; task < vehicle->tasks + vehicle->task_count; task++)
            if (task->used && task != running && task->priority > running->priority &&
                task->ready_ns < first)
                first = task->ready_ns;
    }
    return first;
}

static void resume(Task *task)
{
    lab.running = task;
    lab.horizon_ns = horizon(task);
    task->ran = ++lab.turns;
    swapcontext(&lab.owner, &task->context);
    if (!task->used) munmap(task->stack, task->stack_bytes); // it ended itself
    lab.running = NULL;
}

// Runs the apps until a time, or until the owner is asked or packed something.
const Event *lab_run(int64_t until_ns)
{
    lab.until_ns = until_ns;
    lab.event.kind = EVENT_NONE;
    if (lab.asked) {
        Task *task = lab.asked;
        lab.asked = NULL;
        lab.now_ns = task->vehicle->free_ns;
        if (task->used) resume(task);
    }
    while (lab.event.kind == EVENT_NONE) {
        int64_t when;
        Task *task = next_task(&when);
        if (!task || when >= until_ns) break;
        Vehicle *vehicle = task->vehicle;
        lab.now_ns = when;
        vehicle->free_ns = when;
        resume(task);
    }
    if (lab.event.kind == EVENT_NONE && lab.now_ns < until_ns) lab.now_ns = until_ns;
    return &lab.event;
}

void yield_event(void)
{
    Task *task = lab.running;
    lab.event.vehicle = task->vehicle->number;
    lab.event.time_ns = task->vehicle->free_ns;
    lab.asked = task;
    to_owner(task);
    lab.running = task;
    lab.event.kind = EVENT_NONE;
}

static void report_event(int kind, const char *text)
{
    snprintf((char *)lab.event.data, sizeof lab.event.data, "%s", text);
    lab.event.size = (int)strlen((char *)lab.event.data);
    lab.event.kind = kind;
    yield_event();
}

void misuse(const char *what)
{
    for (;;) report_event(EVENT_MISUSE, what);
}

void spend(int64_t ns)
{
    Task *task = lab.running;
    lab.calls++;
    if (!task) return; // a callback of a variable that the owner reads
    Vehicle *vehicle = task->vehicle;
    int64_t done = vehicle->free_ns + ns;
    // What has more to say or to do interrupts it, and takes the processor's time.
    while (done >= lab.horizon_ns) {
        if (lab.horizon_ns > vehicle->free_ns) vehicle->free_ns = lab.horizon_ns;
        int64_t left = done - vehicle->free_ns;
        task->ready_ns = vehicle->free_ns;
        to_owner(task);
        done = vehicle->free_ns + left;
        if (left == 0) break;
    }
    vehicle->free_ns = done;
    if (done - task->began_ns > lab.spin_ns) report_event(EVENT_SPINS, task->name);
}

bool wait_for(struct Queue *queue, bool wants_room, int64_t until_ns)
{
    Task *task = lab.running;
    if (!task) return false;
    task->waits = queue;
    task->wants_room = wants_room;
    task->ready_ns = until_ns;
    to_owner(task);
    task->began_ns = task->vehicle->free_ns;
    bool woken = queue && task->waits == NULL;
    task->waits = NULL;
    return woken;
}

void wake(Vehicle *vehicle, struct Queue *queue, bool room)
{
    Task *best = NULL;
    for (Task *task = vehicle->tasks; task < vehicle->tasks + vehicle->task_count; task++)
        if (task->used && task->waits == queue && task->wants_room == room &&
            (!best || task->priority > best->priority))
            best = task;
    if (!best) return;
    int64_t now = lab.running ? lab.running->vehicle->free_ns : lab.now_ns;
    best->waits = NULL;
    best->ready_ns = now;
    Task *task = lab.running;
    if (task && best->priority > task->priority) { // it goes on at once
        task->ready_ns = now;
        to_owner(task);
    }
}

// ---- the owner's side ------------------------------------------------------------------------------------------------

static char (*copy_names(int count, const char *const *names))[64]
{
    char (*copy)[64] = calloc((size_t)count + 1, sizeof *copy);
    for (int i = 0; copy && i < count; i++) snprintf(copy[i], sizeof copy[i], "%s", names[i]);
    return copy;
}

int lab_begin(int count, int log_name_count, const char *const *names, int parameter_name_count,
              const char *const *known, int64_t line_fixed_ns, int64_t line_byte_ns,
              int64_t spin_ns)
{
    memset(&lab, 0, sizeof lab);
    lab.count = count;
    lab.log_name_count = log_name_count;
    lab.line_fixed_ns = line_fixed_ns;
    lab.line_byte_ns = line_byte_ns;
    lab.spin_ns = spin_ns;
    lab.vehicles = calloc((size_t)count, sizeof *lab.vehicles);
    lab.log_names = copy_names(log_name_count, names);
    lab.parameter_names = copy_names(parameter_name_count, known);
    lab.parameter_name_count = parameter_name_count;
    if (!lab.vehicles || !lab.log_names || !lab.parameter_names) return -1;
    for (int k = 0; k < count; k++) {
        lab.vehicles[k].number = k;
        lab.vehicles[k].log_values = calloc((size_t)log_name_count, sizeof(double));
        lab.vehicles[k].parameter_values = calloc((size_t)parameter_name_count + 1, sizeof(double));
        if (!lab.vehicles[k].log_values || !lab.vehicles[k].parameter_values) return -1;
    }
    watch_for_crashes();
    return 0;
}

double *lab_log_values(int vehicle) { return lab.vehicles[vehicle].log_values; }

double *lab_parameter_values(int vehicle) { return lab.vehicles[vehicle].parameter_values; }

void lab_off(int number)
{
    Vehicle *vehicle = &lab.vehicles[number];
    if (lab.asked && lab.asked->vehicle == vehicle) lab.asked = NULL;
    for (int i = 0; i < MAX_TASKS; i++) end_task(&vehicle->tasks[i]);
    if (vehicle->library) dlclose(vehicle->library);
    vehicle->library = NULL;
    vehicle->on = false;
}

void lab_end(void)
{
    for (int k = 0; k < lab.count; k++) {
        lab_off(k);
        free(lab.vehicles[k].log_values);
        free(lab.vehicles[k].parameter_values);
    }
    free(lab.vehicles);
    free(lab.log_names);
    free(lab.parameter_names);
    memset(&lab, 0, sizeof lab);
}

static void app_task(void *main) { ((void (*)(void))main)(); }

static void radio_task(void *argument)
{
    Vehicle *vehicle = argument;
    for (Job job;;) {
        while (!pop_item(vehicle, &vehicle->radio_jobs, &job))
            wait_for(&vehicle->radio_jobs, false, NEVER);
        lab.event.kind = EVENT_HEARD;
        lab.event.code = vehicle->callback ? job.packet.rssi : -1; // -1: no callback
        lab.event.size = job.packet.size + 1;
        memcpy(lab.event.data, job.packet.raw, (size_t)job.packet.size + 1);
        yield_event();
        if (vehicle->callback) vehicle->callback(&job.packet);
    }
}

static void parameter_task(void *argument)
{
    Vehicle *vehicle = argument;
    for (Job job;;) {
        while (!pop_item(vehicle, &vehicle->parameter_jobs, &job))
            wait_for(&vehicle->parameter_jobs, false, NEVER);
        job.callback();
    }
}

// Power on: loads a private copy of the app. Returns what is wrong, or NULL.
const char *lab_boot(int number, const char *path, int64_t now_ns, int64_t clock_ns,
                     int64_t drift_ppb, uint64_t address, int channel, int speed)
{
    Vehicle *vehicle = &lab.vehicles[number];
    vehicle->log_count = vehicle->parameter_count = 0;
    vehicle->callback = NULL;
    vehicle->app_overflow = false;
    vehicle->timers = NULL;
    vehicle->timer_task = NULL;
    vehicle->boot_ns = vehicle->free_ns = vehicle->line_ns = now_ns;
    vehicle->clock_ns = clock_ns;
    vehicle->drift_ppb = drift_ppb;
    vehicle->address = address;
    vehicle->channel = channel;
    vehicle->speed = speed;
    init_queue(&vehicle->radio_jobs, vehicle->radio_storage, MAX_INBOX, sizeof(Job));
    init_queue(&vehicle->parameter_jobs, vehicle->parameter_storage, MAX_INBOX, sizeof(Job));
    init_queue(&vehicle->app_channel, vehicle->app_storage, 10, 32);
    init_queue(&vehicle->timer_signal, NULL, 1, 0);
    lab.loading = vehicle;
    vehicle->library = dlopen(path, RTLD_NOW | RTLD_LOCAL);
    lab.loading = NULL;
    if (!vehicle->library) return dlerror();
    void *main = dlsym(vehicle->library, "appMain");
    if (!main) return "no function appMain";
    if (vehicle->log_count < 0 || vehicle->parameter_count < 0) return "more than 512 variables";
    vehicle->on = true;
    if (!add_task(vehicle, radio_task, vehicle, 3, "radio") ||
        !add_task(vehicle, parameter_task, vehicle, 1, "parameters") ||
        !add_task(vehicle, app_task, main, APP_PRIORITY, "app"))
        return "no memory for its tasks";
    return NULL;
}

// A peer-to-peer packet has come from the radio. Returns 0 when the firmware's queue is full.
int lab_receive(int number, int64_t now_ns, const uint8_t *raw, int size, int rssi)
{
    Vehicle *vehicle = &lab.vehicles[number];
    Job job = {0};
    if (!vehicle->on) return 1;
    lab.now_ns = now_ns;
    job.packet.size = (uint8_t)(size - 1);
    job.packet.rssi = (uint8_t)rssi;
    memcpy(job.packet.raw, raw, (size_t)size);
    return push_item(vehicle, &vehicle->radio_jobs, &job, false);
}

// A packet of the app channel has come from the ground. Returns 0 when the queue of ten is full.
int lab_app_channel(int number, int64_t now_ns, const uint8_t *data, int size)
{
    Vehicle *vehicle = &lab.vehicles[number];
    uint8_t item[32] = {0};
    if (!vehicle->on) return 1;
    lab.now_ns = now_ns;
    item[0] = (uint8_t)size;
    memcpy(item + 1, data, (size_t)size);
    if (push_item(vehicle, &vehicle->app_channel, item, false)) return 1;
    vehicle->app_overflow = true;
    return 0;
}

int lab_count(int number, int parameters)
{
    return parameters ? lab.vehicles[number].parameter_count : lab.vehicles[number].log_count;
}

static Variable *variable_of(int number, int parameters, int index)
{
    Vehicle *vehicle = &lab.vehicles[number];
    return parameters ? &vehicle->parameters[index] : &vehicle->logs[index];
}

const char *lab_name(int number, int parameters, int index)
{
    return variable_of(number, parameters, index)->name;
}

int lab_type(int number, int parameters, int index)
{
    return variable_of(number, parameters, index)->type;
}

double lab_get(int number, int parameters, int index)
{
    return variable_value(variable_of(number, parameters, index));
}

void lab_set(int number, int64_t now_ns, int index, double value)
{
    lab.now_ns = now_ns;
    set_variable(&lab.vehicles[number], variable_of(number, 1, index), value);
}
