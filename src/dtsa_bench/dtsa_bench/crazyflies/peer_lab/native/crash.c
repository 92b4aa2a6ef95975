// What ends the process: a crash of an app, or one that computes for ever without a call of the firmware. The name of
// the app that did it goes to standard error, in one line, and the process ends with a code of its own.
#define _GNU_SOURCE
#include "lab.h"

#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/time.h>
#include <unistd.h>

#define CRASH_CODE 70
#define SILENT_SECONDS 5 // of this machine's processor

static uint8_t signal_stack[64 * 1024];

static void end(const char *what)
{
    const Task *task = lab.running;
    char line[200];
    int64_t us = task->vehicle->free_ns / 1000;
    int size =
        snprintf(line, sizeof line, "peer-lab: app of agent %d, task %s, at %lld.%06lld s: %s\n",
                 task->vehicle->number + 1, task->name, (long long)(us / 1000000),
                 (long long)(us % 1000000), what);
    if (write(STDERR_FILENO, line, (size_t)size) < 0) _exit(CRASH_CODE);
    _exit(CRASH_CODE);
}

static void crashed(int number, siginfo_t *information, void *context)
{
    (void)context;
    if (!lab.running) { // not an app's: as without this handler
        signal(number, SIG_DFL);
        raise(number);
        return;
    }
    const uint8_t *guard = lab.running->stack, *place = information->si_addr;
    char what[80];
    if (number == SIGSEGV && place >= guard && place < guard + 4096)
        snprintf(what, sizeof what, "its stack overflowed");
    else
        snprintf(what, sizeof what, "%s (%s)", number == SIGABRT ? "it aborted" : "it crashed",
                 strsignal(number));
    end(what);
}

static void looked(int number)
{
    static uint64_t before;
    static int silent;
    (void)number;
    silent = lab.running && lab.calls == before ? silent + 1 : 0;
    before = lab.calls;
    if (silent >= SILENT_SECONDS) end("it computes for ever and calls nothing of the firmware");
}

void watch_for_crashes(void)
{
    stack_t stack = {.ss_sp = signal_stack, .ss_size = sizeof signal_stack};
    sigaltstack(&stack, NULL);
    struct sigaction action = {.sa_sigaction = crashed, .sa_flags = SA_SIGINFO | SA_ONSTACK};
    const int signals[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT};
    for (size_t i = 0; i < sizeof signals / sizeof *signals; i++)
        sigaction(signals[i], &action, NULL);
    struct sigaction look = {.sa_handler = looked, .sa_flags = SA_RESTART | SA_ONSTACK};
    sigaction(SIGPROF, &look, NULL);
    struct itimerval every = {{1, 0}, {1, 0}};
    setitimer(ITIMER_PROF, &every, NULL);
}
