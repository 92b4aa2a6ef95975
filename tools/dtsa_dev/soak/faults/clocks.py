"""The clock of the machine is set while a flight is under way: nobody in a flight asks what time of day it is."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from dtsa_dev.soak.checks import flies_on, interrupted_well, met
from dtsa_dev.soak.flights import ENDLESS, flying

from .fault import LOCKSTEP, REALTIME, Fault

# Stands before the C library: CLOCK_REALTIME is off by as many seconds as the file says, for who reads it and for who
# waits until a time by it. A missing file says 0.
_SHIM = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>

static long step(void) {
    const char *name = getenv("CLOCK_STEP_FILE");
    FILE *file = name ? fopen(name, "r") : NULL;
    long seconds = 0;
    if (file) {
        if (fscanf(file, "%ld", &seconds) != 1) seconds = 0;
        fclose(file);
    }
    return seconds;
}

int clock_gettime(clockid_t clock, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) *(void **)&real = dlsym(RTLD_NEXT, "clock_gettime");
    int result = real(clock, now);
    if (!result && clock == CLOCK_REALTIME) now->tv_sec += step();
    return result;
}

static struct timespec by_the_kernel(const struct timespec *until) {
    struct timespec right = *until;
    if (right.tv_sec > 500000000) right.tv_sec -= step();
    return right;
}

typedef int (*cond_wait)(pthread_cond_t *, pthread_mutex_t *, const struct timespec *);

int pthread_cond_timedwait(pthread_cond_t *cond, pthread_mutex_t *mutex, const struct timespec *until) {
    static cond_wait real;
    if (!real) *(void **)&real = dlvsym(RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2");
    if (!real) *(void **)&real = dlsym(RTLD_NEXT, "pthread_cond_timedwait");
    struct timespec right = by_the_kernel(until);
    return real(cond, mutex, &right);
}

int pthread_mutex_timedlock(pthread_mutex_t *mutex, const struct timespec *until) {
    static int (*real)(pthread_mutex_t *, const struct timespec *);
    if (!real) *(void **)&real = dlsym(RTLD_NEXT, "pthread_mutex_timedlock");
    struct timespec right = by_the_kernel(until);
    return real(mutex, &right);
}

int sem_timedwait(sem_t *sem, const struct timespec *until) {
    static int (*real)(sem_t *, const struct timespec *);
    if (!real) *(void **)&real = dlsym(RTLD_NEXT, "sem_timedwait");
    struct timespec right = by_the_kernel(until);
    return real(sem, &right);
}

int gettimeofday(struct timeval *now, void *zone) {
    struct timespec fine;
    (void)zone;
    if (clock_gettime(CLOCK_REALTIME, &fine)) return -1;
    now->tv_sec = fine.tv_sec;
    now->tv_usec = fine.tv_nsec / 1000;
    return 0;
}
"""


def _shim(directory: Path) -> Path:
    """The library that sets the clock of those that load it."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("g++")
    met(compiler, "no C compiler")
    source, library = directory / "step.c", directory / "step.so"
    source.write_text(_SHIM)
    command = [str(compiler), "-x", "c", "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    met(done.returncode == 0, f"no shim: {done.stderr.strip()[-300:]}")
    return library


def _seen_ahead_s() -> float:
    """By how much the clock of a process that is started now is ahead of ours, s."""
    command = [sys.executable, "-c", "import time; print(time.time())"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    met(done.returncode == 0, f"no process: {done.stderr.strip()[-300:]}")
    return float(done.stdout) - time.time()


def _stepped(words: tuple[str, ...], *steps_s: int) -> Callable[[Path], None]:
    def run(directory: Path) -> None:
        file = directory / "step"
        changed = {"LD_PRELOAD": str(_shim(directory)), "CLOCK_STEP_FILE": str(file)}
        before = {name: os.environ.get(name) for name in changed}
        os.environ.update(changed)
        try:
            file.write_text("-3600\n")
            met(_seen_ahead_s() < -3000, "the shim does not set the clock")
            file.write_text("0\n")
            with flying(directory / "flight", *words, *ENDLESS) as flight:
                for step_s in steps_s:
                    fresh = directory / "fresh"
                    fresh.write_text(f"{step_s}\n")
                    fresh.replace(file)
                    time.sleep(0.5)
                    flies_on(flight)
                found = interrupted_well(flight)
                met("not been heard of" not in flight.said(), "agents are taken for lost")
                met(found["end"] == "stopped", f"the flight ended: {found['end']}")
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name)
                else:
                    os.environ[name] = value

    return run


_UNHARMED = "nothing: only clocks that are never set are used; the flight goes on, the bag verifies"

FAULTS = (
    Fault("clock set back, lockstep", "the machine's clock is set back by an hour, then to a day ahead, lockstep",
          _UNHARMED, _stepped(LOCKSTEP, -3600, 86_400)),
    Fault("clock set back, real time", "the machine's clock is set back by an hour, then to a day ahead, real time",
          _UNHARMED, _stepped(REALTIME, -3600, 86_400)),
)  # fmt: skip
