/* Reads datagrams from a UDP socket with the times at which the kernel got them. Linux. */
#ifndef DTSA_SOCKET_READER_H
#define DTSA_SOCKET_READER_H

#include "dtsa_station.h"

enum {
    SOCKET_BURST = 16, /* datagrams at a time */
    SOCKET_LONGEST =
        512 /* bytes of a datagram that are looked at; frames of ours are far shorter */
};

typedef struct socket_datagram {
    int64_t arrival_ns; /* CLOCK_MONOTONIC */
    int length, own;
    uint8_t data[SOCKET_LONGEST];
} socket_datagram;

/* The kernel's stamps are CLOCK_REALTIME. Both clocks are looked at after datagrams have been read: when
 * the first one has been set since the last look, stamps are worth nothing, and the look stands for
 * them. */
typedef struct socket_reader {
    int descriptor;
    uint8_t address[4]; /* with the port: where own datagrams come from */
    uint16_t port;
    int64_t ahead_ns,
        now_ns; /* CLOCK_REALTIME of CLOCK_MONOTONIC, and the latter, at the last look */
    int is_usable;
    uint32_t clock_steps,
        unreadable; /* how often that clock was set, the socket could not be read */
    socket_datagram datagrams[SOCKET_BURST];
} socket_reader;

void socket_start(socket_reader *r, int descriptor);
/* Fills `datagrams` with at most so many, in the order of arrival; -> their number. */
int socket_read(socket_reader *r, int most);
/* Reads at most so many, and hands those of others to a station whose clock was ahead of CLOCK_MONOTONIC
 * by an offset at `began_ns` and drifts, parts per billion; -> how many were read. */
int socket_deliver(socket_reader *r, int most, dtsa_station *station, int64_t offset_ns,
                   int64_t drift_ppb, int64_t began_ns);
void socket_look(socket_reader *r, int64_t ahead_ns, int64_t now_ns);
/* -1: the kernel has given no stamp. */
int64_t socket_arrival(const socket_reader *r, int64_t stamp_ns);

#endif
