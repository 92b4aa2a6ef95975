/* Which slot it is, where no channel says so: taken from the first frame heard, or from the own
 * clock in silence; and how slots of a group stay together. No clock is read: every function is
 * told what the own clock shows.
 *
 *   LISTENING --- a frame ---> JOINED            the frame says which slot it was sent in
 *       |                        ^  |
 *       | silence                |  +-- a frame of a later time: take that one (RESTARTED)
 *       v                        |
 *     ALONE ------ a frame ------+               of the same time, or of a later one (RESTARTED)
 *
 * Of two groups that meet the one whose slots have the larger numbers stays as it is.
 */
#include <string.h>

#include "core.h"
#include "timebase.h"

int64_t dtsa_align(dtsa_aligner *a, int64_t offset)
{
    if (offset < -a->limit_ns || offset > a->limit_ns) {
        a->ignored++;
        a->ignored_in_a_row++;
        return 0;
    }
    a->ignored_in_a_row = 0;
    int at = a->count++;
    for (; at > 0 && a->offsets[at - 1] > offset; at--) a->offsets[at] = a->offsets[at - 1];
    a->offsets[at] = offset;
    if (a->count < a->receptions) return 0;
    const int64_t twice = a->offsets[a->count / 2] + a->offsets[(a->count - 1) / 2];
    a->count = 0;
    a->corrections++;
    /* Rounded half away from zero, so that both directions weigh the same. */
    const int64_t size = ((twice < 0 ? -twice : twice) * a->share + 65536) / 131072;
    return twice < 0 ? -size : size;
}

void dtsa_align_reset(dtsa_aligner *a)
{
    a->count = 0;
    a->ignored_in_a_row = 0;
}

/* A number that looks random, of 64 bits (splitmix64). */
static uint64_t mixed(uint64_t seed, uint64_t id)
{
    return mix64(seed * 0x9e3779b97f4a7c15ULL + id * 0xd1b54a32d192ed03ULL - 0x9e3779b97f4a7c15ULL);
}

int dtsa_timebase_init(dtsa_timebase *b, int agents, int anchor_every, int64_t slot_ns, int id,
                       uint64_t seed)
{
    if (agents < 1 || anchor_every < 1 || slot_ns < 1 || id < 1) return 0;
    memset(b, 0, sizeof *b);
    b->slot_ns = slot_ns;
    b->round_ns = (int64_t)anchor_every * agents * slot_ns;
    /* Spread over a whole round of anchors: one is the first, and the others hear it while they
     * still listen. */
    b->wait_ns = b->round_ns + (int64_t)(mixed(seed, (uint64_t)id) % (uint64_t)b->round_ns);
    b->aligner = (dtsa_aligner){.receptions = 9, .share = 32768, .limit_ns = 1000000};
    b->deadline_ns = INT64_MAX;
    return 1;
}

int64_t dtsa_timebase_start(dtsa_timebase *b, int64_t now)
{
    b->state = DTSA_LISTENING;
    dtsa_align_reset(&b->aligner);
    b->deadline_ns = now + b->wait_ns;
    return b->deadline_ns;
}

int dtsa_timebase_wake(dtsa_timebase *b, int64_t now)
{
    if (b->state != DTSA_LISTENING || now < b->deadline_ns) return 0;
    /* Not slot 0: that is for agents that are told to start together and may speak at once. */
    b->origin_ns = now - b->round_ns;
    b->state = DTSA_ALONE;
    return 1;
}

int64_t dtsa_timebase_slot(const dtsa_timebase *b, int64_t now)
{
    const int64_t since = now - b->origin_ns;
    return since / b->slot_ns - (since % b->slot_ns < 0);
}

int64_t dtsa_timebase_slot_start(const dtsa_timebase *b, int64_t slot)
{
    return b->origin_ns + slot * b->slot_ns;
}

int dtsa_timebase_hear(dtsa_timebase *b, int64_t slot, int64_t start_ns)
{
    const int64_t origin = start_ns - slot * b->slot_ns; /* where the sender's slot 0 lies */
    if (b->state == DTSA_LISTENING) {
        b->origin_ns = origin;
        b->state = DTSA_JOINED;
        return DTSA_RESTARTED;
    }
    const int64_t ahead = b->origin_ns - origin;
    if ((ahead < 0 ? -ahead : ahead) < b->slot_ns / 2) {
        /* Slot starts move towards the sender's: a frame that came later than expected moves them
         * back. */
        b->origin_ns += dtsa_align(&b->aligner, -ahead);
        b->state = DTSA_JOINED;
        return DTSA_ALIGNED;
    }
    if (ahead < 0) return DTSA_FOREIGN;
    dtsa_align_reset(&b->aligner);
    b->origin_ns = origin;
    b->state = DTSA_JOINED;
    b->restarts++;
    return DTSA_RESTARTED;
}
