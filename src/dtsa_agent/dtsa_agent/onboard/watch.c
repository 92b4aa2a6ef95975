/* What an app notes in the laboratory, for the bag of its flight (peer_lab/onboard.py). On a vehicle
 * there is none of this. */
#ifdef PEER_LAB
#include "watch.h"

#include <string.h>

#include "core.h"
#include "peer_lab.h"

/* Without gaps, little-endian: see onboard.py. */
typedef struct __attribute__((packed)) opened_note {
    uint8_t kind, anew, reason;
    int64_t slot, start_ns;
    uint16_t present, chosen;
    uint32_t digest;
    double score, position[3], velocity[3], command[3], goal[3];
} opened_note;

typedef struct __attribute__((packed)) heard_note {
    uint8_t kind, accepted, sender, length;
    int64_t slot, at_ns;
    uint8_t data[DTSA_FRAME_MAX];
} heard_note;

static void opened(void *context, int64_t slot, int64_t start, int64_t now, int is_first)
{
    (void)now;
    const dtsa_agent *a = context;
    opened_note n = {
        .kind = 'O',
        .anew = (uint8_t)is_first,
        .reason = (uint8_t)a->decision.reason,
        .slot = slot,
        .start_ns = start,
        .present = a->present,
        .chosen = (uint16_t)a->decision.chosen,
        .digest = a->decision.digest,
        .score = a->decision.score,
    };
    memcpy(n.position, a->position, sizeof n.position);
    memcpy(n.velocity, a->velocity, sizeof n.velocity);
    memcpy(n.command, a->command, sizeof n.command);
    memcpy(n.goal, a->goal, sizeof n.goal);
    peerLabRecord(&n, sizeof n);
}

static void note(char kind, int accepted, int sender, int64_t slot, const uint8_t *datagram,
                 int length, int64_t at)
{
    heard_note n = {
        (uint8_t)kind, (uint8_t)accepted, (uint8_t)sender, (uint8_t)length, slot, at, {0}};
    if (length) memcpy(n.data, datagram, (size_t)length);
    peerLabRecord(&n, sizeof n);
}

static void heard(void *context, int sender, int64_t slot, const uint8_t *datagram, int length,
                  int64_t arrival, int accepted)
{
    (void)context;
    note('H', accepted, sender, slot, datagram, length, arrival);
}

static void restarted(void *context, int64_t slot)
{
    (void)context;
    note('A', 0, 0, slot, NULL, 0, 0);
}

static void sent(void *context, int64_t slot, const uint8_t *datagram, int length, int64_t now)
{
    (void)context;
    note('S', 0, 0, slot, datagram, length, now);
}

void observe(dtsa_station *station, dtsa_agent *agent)
{
    const dtsa_station_events events = {
        .context = agent, .opened = opened, .restarted = restarted, .sent = sent, .heard = heard};
    dtsa_station_observe(station, &events);
}
#endif
