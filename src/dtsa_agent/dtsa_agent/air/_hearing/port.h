/* What the hearing asks of a port: the datagrams that have arrived.
 *
 * A port is compiled code of its own. It hands Hearing a capsule named DTSA_PORT that holds one
 * air_port. Times are ns of CLOCK_MONOTONIC. */
#ifndef DTSA_PORT_H
#define DTSA_PORT_H

#include <stdint.h>

#define DTSA_PORT "dtsa_agent.air.port"

enum {
    BURST = 16,
    LONGEST = 512
}; /* datagrams at a time; bytes of a datagram that are looked at */

typedef struct arrived {
    const uint8_t *data; /* of the port, until it is asked again */
    long length;
    int64_t arrival;
    int own; /* this very agent has sent it */
} arrived;

typedef struct air_port {
    int descriptor; /* for poll: readable when something has arrived */
    int (*receive)(struct air_port *port, arrived batch[BURST]); /* how many have arrived */
} air_port;

#endif
