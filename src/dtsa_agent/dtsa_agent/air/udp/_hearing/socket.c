/* Datagrams from the kernel, with the times at which they arrived. */
#include "hearing.h"

#include <errno.h>
#include <string.h>
#include <time.h>

static const int64_t SECOND = 1000000000;
static const int64_t EXACT =
    2000; /* between two looks at one clock: good enough for the other one in between */
static const int64_t STEP =
    1000000; /* the clock of the stamps has been set if it moved by this between two looks */
static const int64_t OLDEST =
    60000000000;     /* a stamp cannot be older than the longest sleep of a process */
enum { STAMP = 35 }; /* SO_TIMESTAMPNS of Linux */

static int64_t read_clock(clockid_t which)
{
    struct timespec t;
    clock_gettime(which, &t);
    return (int64_t)t.tv_sec * SECOND + t.tv_nsec;
}

int64_t now_monotonic(void) { return read_clock(CLOCK_MONOTONIC); }

void stamps_looked(stamp_clock *s, int64_t ahead, int64_t now)
{
    const int64_t moved = ahead - s->ahead;
    s->usable = moved >= -STEP && moved <= STEP;
    s->steps += !s->usable;
    s->ahead = ahead;
    s->now = now;
}

/* Both clocks, the best of three looks. */
void stamps_look(stamp_clock *s)
{
    int64_t ahead = 0, now = 0, best = INT64_MAX;
    for (int look = 0; look < 3 && best >= EXACT; look++) {
        const int64_t before = now_monotonic(), real = read_clock(CLOCK_REALTIME);
        const int64_t after = now_monotonic();
        if (after - before >= best) continue;
        best = after - before;
        ahead = real - floor_div(before + after, 2);
        now = after;
    }
    stamps_looked(s, ahead, now);
}

int64_t stamps_arrival(const stamp_clock *s, int64_t stamp)
{
    if (stamp < 0 || !s->usable) return s->now;
    const int64_t arrival = stamp - s->ahead;
    return arrival - s->now > -OLDEST && arrival <= s->now ? arrival : s->now;
}

static int64_t stamp_of(struct msghdr *message)
{
    for (struct cmsghdr *note = CMSG_FIRSTHDR(message); note; note = CMSG_NXTHDR(message, note)) {
        struct timespec t;
        if (note->cmsg_level != SOL_SOCKET || note->cmsg_type != STAMP) continue;
        if (note->cmsg_len < CMSG_LEN(sizeof t)) continue;
        memcpy(&t, CMSG_DATA(note), sizeof t);
        return (int64_t)t.tv_sec * SECOND + t.tv_nsec;
    }
    return -1;
}

static void prepare(hearing *h)
{
    for (int i = 0; i < BURST; i++) {
        arrived *a = &h->batch[i];
        a->room = (struct iovec){a->data, LONGEST};
        h->vector[i].msg_hdr = (struct msghdr){.msg_name = &a->source,
                                               .msg_namelen = sizeof a->source,
                                               .msg_iov = &a->room,
                                               .msg_iovlen = 1,
                                               .msg_control = a->notes,
                                               .msg_controllen = NOTES};
    }
}

void hearing_receive(hearing *h)
{
    prepare(h);
    const int count = recvmmsg(h->socket, h->vector, BURST, MSG_DONTWAIT, NULL);
    h->at = 0;
    h->count = count < 0 ? 0 : count;
    if (count < 0 && errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR)
        h->unreadable++; /* an interface that has gone, for example: it may come back */
    if (!h->count) return;
    stamps_look(&h->stamps); /* afterwards: however long this process was kept waiting, all have
                                arrived before */
    for (int i = 0; i < h->count; i++) {
        arrived *a = &h->batch[i];
        a->arrival = stamps_arrival(&h->stamps, stamp_of(&h->vector[i].msg_hdr));
        a->own = a->source.sin_port == h->address.sin_port &&
                 a->source.sin_addr.s_addr == h->address.sin_addr.s_addr;
    }
}
