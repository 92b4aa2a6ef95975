#define _GNU_SOURCE /* recvmmsg */
#include "socket_reader.h"

#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>

static const int64_t SECOND = 1000000000;
static const int64_t STEP_NS =
    1000000; /* between two looks: the clock of the stamps has been set */
static const int64_t EXACT_NS =
    2000; /* between two looks at one clock: good enough for the other */
static const int64_t OLDEST_NS = 60 * SECOND; /* the longest sleep of a process */
enum { TIMESTAMP = 35 };                      /* SO_TIMESTAMPNS of Linux */

static int64_t nanoseconds(struct timespec t) { return (int64_t)t.tv_sec * SECOND + t.tv_nsec; }

static int64_t clock_ns(clockid_t clock)
{
    struct timespec t;
    clock_gettime(clock, &t);
    return nanoseconds(t);
}

void socket_look(socket_reader *r, int64_t ahead_ns, int64_t now_ns)
{
    const int64_t moved = ahead_ns - r->ahead_ns;
    r->is_usable = moved <= STEP_NS && moved >= -STEP_NS;
    r->clock_steps += !r->is_usable;
    r->ahead_ns = ahead_ns;
    r->now_ns = now_ns;
}

/* The best of three looks at both clocks. */
static void look(socket_reader *r)
{
    int64_t best = INT64_MAX, ahead = 0, now = 0;
    for (int i = 0; i < 3 && best >= EXACT_NS; i++) {
        const int64_t before = clock_ns(CLOCK_MONOTONIC), real = clock_ns(CLOCK_REALTIME),
                      after = clock_ns(CLOCK_MONOTONIC);
        if (after - before >= best) continue;
        best = after - before;
        ahead = real - (before + after) / 2;
        now = after;
    }
    socket_look(r, ahead, now);
}

void socket_start(socket_reader *r, int descriptor)
{
    r->descriptor = descriptor;
    look(r);
    r->clock_steps = 0;
}

int64_t socket_arrival(const socket_reader *r, int64_t stamp_ns)
{
    const int64_t arrival = stamp_ns - r->ahead_ns;
    const int is_possible = arrival <= r->now_ns && arrival > r->now_ns - OLDEST_NS;
    return stamp_ns >= 0 && r->is_usable && is_possible ? arrival : r->now_ns;
}

static int64_t stamp_of(struct msghdr *message)
{
    for (struct cmsghdr *note = CMSG_FIRSTHDR(message); note; note = CMSG_NXTHDR(message, note)) {
        struct timespec t;
        if (note->cmsg_level != SOL_SOCKET || note->cmsg_type != TIMESTAMP) continue;
        if (note->cmsg_len < CMSG_LEN(sizeof t)) continue;
        memcpy(&t, CMSG_DATA(note), sizeof t);
        return nanoseconds(t);
    }
    return -1;
}

int socket_read(socket_reader *r, int most)
{
    struct mmsghdr messages[SOCKET_BURST];
    struct iovec data[SOCKET_BURST];
    struct sockaddr_in sources[SOCKET_BURST];
    _Alignas(struct cmsghdr) uint8_t notes[SOCKET_BURST][CMSG_SPACE(sizeof(struct timespec))];
    if (most > SOCKET_BURST) most = SOCKET_BURST;
    for (int i = 0; i < most; i++) {
        data[i] = (struct iovec){r->datagrams[i].data, SOCKET_LONGEST};
        messages[i].msg_hdr = (struct msghdr){.msg_name = &sources[i],
                                              .msg_namelen = sizeof sources[i],
                                              .msg_iov = &data[i],
                                              .msg_iovlen = 1,
                                              .msg_control = notes[i],
                                              .msg_controllen = sizeof notes[i]};
    }
    const int count = recvmmsg(r->descriptor, messages, (unsigned)most, MSG_DONTWAIT, NULL);
    if (count <= 0) { /* an interface that has gone, for example: it may come back */
        r->unreadable += count < 0 && errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR;
        return 0;
    }
    look(r); /* afterwards: however long this process was kept waiting, all have arrived before */
    for (int i = 0; i < count; i++) {
        socket_datagram *d = &r->datagrams[i];
        d->length = (int)messages[i].msg_len;
        d->arrival_ns = socket_arrival(r, stamp_of(&messages[i].msg_hdr));
        d->own = sources[i].sin_port == htons(r->port) &&
                 !memcmp(&sources[i].sin_addr, r->address, sizeof r->address);
    }
    return count;
}

/* As ClockMap.local_ns (core/station.py): rounded down. */
static int64_t local_ns(int64_t monotonic_ns, int64_t offset_ns, int64_t drift_ppb,
                        int64_t began_ns)
{
    const __int128 drifted = (__int128)(monotonic_ns - began_ns) * drift_ppb;
    const int64_t whole = (int64_t)(drifted / SECOND);
    return monotonic_ns + offset_ns + whole - (drifted % SECOND < 0);
}

int socket_deliver(socket_reader *r, int most, dtsa_station *station, int64_t offset_ns,
                   int64_t drift_ppb, int64_t began_ns)
{
    const int count = socket_read(r, most);
    for (int i = 0; i < count; i++) {
        const socket_datagram *d = &r->datagrams[i];
        if (!d->own)
            dtsa_station_receive(station, d->data, d->length,
                                 local_ns(d->arrival_ns, offset_ns, drift_ppb, began_ns));
    }
    return count;
}
