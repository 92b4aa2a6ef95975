// Stands before the C library (LD_PRELOAD): CLOCK_REALTIME is off by as many seconds as the file CLOCK_STEP_FILE
// says, for those that read it and for those that wait until a time by it. A missing file says 0.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>

static long step(void)
{
    const char *name = getenv("CLOCK_STEP_FILE");
    FILE *file = name ? fopen(name, "r") : NULL;
    long seconds = 0;
    if (file) {
        if (fscanf(file, "%ld", &seconds) != 1) seconds = 0;
        fclose(file);
    }
    return seconds;
}

static void *next(const char *name)
{
    void *versioned = dlvsym(RTLD_NEXT, name, "GLIBC_2.3.2"); // of a condition there are two
    return versioned ? versioned : dlsym(RTLD_NEXT, name);
}

int clock_gettime(clockid_t clock, struct timespec *now)
{
    static int (*real)(clockid_t, struct timespec *);
    if (!real) *(void **)&real = next("clock_gettime");
    int result = real(clock, now);
    if (!result && clock == CLOCK_REALTIME) now->tv_sec += step();
    return result;
}

// A function that waits until a time by the clock, which the kernel is told by its own.
#define WAITS(name, parameters, ...)                                                               \
    int name(parameters, const struct timespec *until)                                             \
    {                                                                                              \
        static int (*real)(parameters, const struct timespec *);                                   \
        struct timespec right = *until;                                                            \
        if (!real) *(void **)&real = next(#name);                                                  \
        if (right.tv_sec > 500000000) right.tv_sec -= step();                                      \
        return real(__VA_ARGS__, &right);                                                          \
    }
#define BOTH(a, b) a, b
WAITS(pthread_cond_timedwait, BOTH(pthread_cond_t *c, pthread_mutex_t *m), c, m)
WAITS(pthread_mutex_timedlock, pthread_mutex_t *m, m)
WAITS(sem_timedwait, sem_t *s, s)

int gettimeofday(struct timeval *now, void *zone)
{
    struct timespec fine;
    (void)zone;
    if (clock_gettime(CLOCK_REALTIME, &fine)) return -1;
    *now = (struct timeval){fine.tv_sec, fine.tv_nsec / 1000};
    return 0;
}
