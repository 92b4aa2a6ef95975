/* What an app notes in the laboratory, for the bag of its flight (peer_lab/onboard.py). On a vehicle
 * there is none of this. */
#ifdef PEER_LAB
#include "watch.h"

#include <string.h>

#include "core.h"
#include "peer_lab.h"

/* Without gaps, little-endian: see onboard.py. */
typedef struct __attribute__((packed)) opened_note {
    uint8_t kind, anew, reason, length;
    int64_t slot, start_ns, opened_ns;
    uint16_t present, chosen;
    uint32_t digest;
    double score, position[3], velocity[3], command[3], goal[3];
    uint8_t frame[DTSA_FRAME_MAX];
} opened_note;

typedef struct __attribute__((packed)) heard_note {
    uint8_t kind, accepted, sender, length;
    int64_t slot, at_ns;
    uint8_t data[BOARD_DATAGRAM];
} heard_note;

static void opened(const board *b, int64_t now)
{
    const dtsa_agent *a = b->agent;
    opened_note n = {
        .kind = 'O',
        .anew = (uint8_t)b->anew,
        .reason = (uint8_t)a->decision.reason,
        .length = (uint8_t)b->waiting,
        .slot = b->slot,
        .start_ns = dtsa_timebase_slot_start(&b->hearing.base, b->slot),
        .opened_ns = now,
        .present = a->present,
        .chosen = (uint16_t)a->decision.chosen,
        .digest = a->decision.digest,
        .score = a->decision.score,
    };
    memcpy(n.position, a->position, sizeof n.position);
    memcpy(n.velocity, a->velocity, sizeof n.velocity);
    memcpy(n.command, b->command, sizeof n.command);
    memcpy(n.goal, a->goal, sizeof n.goal);
    memcpy(n.frame, b->frame, (size_t)b->waiting);
    peerLabRecord(&n, sizeof n);
}

static void heard(const board *b, int sender, int64_t slot, const uint8_t *datagram, int length,
                  int64_t arrival, int accepted)
{
    heard_note n = {'H', (uint8_t)accepted, (uint8_t)sender, (uint8_t)length, slot, arrival, {0}};
    (void)b;
    memcpy(n.data, datagram, (size_t)length);
    peerLabRecord(&n, sizeof n);
}

static void anew(const board *b)
{
    const heard_note n = {'A', 0, 0, 0, b->slot, 0, {0}};
    peerLabRecord(&n, sizeof n);
}

static void sent(const board *b, const uint8_t *datagram, int length, int64_t now)
{
    heard_note n = {'S', 0, 0, (uint8_t)length, b->slot, now, {0}};
    memcpy(n.data, datagram, (size_t)length);
    peerLabRecord(&n, sizeof n);
}

const board_watch the_laboratory = {opened, anew, sent, heard};
#endif
