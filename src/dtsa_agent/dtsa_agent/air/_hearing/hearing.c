/* Datagrams, slots and delays of one agent. */
#include <stdlib.h>
#include <string.h>

#include "frame.h"
#include "hearing.h"

enum { UNIT = 10000, DOUBTS = 9, SHARE = 64, STEP = 1000000, NAMED = 8, NEAR_SLOTS = 8 };
static const int64_t PPB = 1000000000;

static int64_t floor_div(int64_t a, int64_t b) /* b > 0 */ { return a / b - (a % b < 0); }

static int64_t limited(int64_t value, int64_t limit)
{
    return value < -limit ? -limit : value > limit ? limit : value;
}

/* ---- the own clock ---- */

/* floor(elapsed * by / of), without a product of 128 bits, which 32-bit processors lack:
 * elapsed = whole * of + rest, 0 <= rest < of. |by| <= DRIFT_MOST = 0.5e9 <= of <= 1.5e9, so that
 * |whole * by| <= |elapsed| + |by| and |rest * by| < 0.75e18: nothing overflows while |elapsed| is
 * less than 2^62 ns, 146 years. */
static int64_t share_of(int64_t elapsed, int64_t by, int64_t of)
{
    const int64_t whole = floor_div(elapsed, of);
    return whole * by + floor_div((elapsed - whole * of) * by, of);
}

int64_t clock_local(const own_clock *c, int64_t monotonic)
{
    return monotonic + c->offset + share_of(monotonic - c->began, c->drift, PPB);
}

int64_t clock_monotonic(const own_clock *c, int64_t local)
{
    const int64_t elapsed = local - c->offset - c->began;
    return c->began + elapsed - share_of(elapsed, c->drift, PPB + c->drift);
}

/* ---- what a datagram says ---- */

static int word(const uint8_t *at) { return at[0] | at[1] << 8; }

/* Of a datagram whose frame has so many bytes. */
static void make_tag(const hearing *h, const uint8_t *data, long frame_length, int64_t slot,
                     uint8_t tag[DTSA_TAG_BYTES])
{
    uint8_t covered[LONGEST];
    const long times = h->head - h->agreed;
    memcpy(covered, data + h->head, (size_t)frame_length);
    memcpy(covered + frame_length, data + h->agreed, (size_t)times);
    dtsa_tag(h->key, h->key_length, h->session, (uint64_t)slot, covered, frame_length + times, tag);
}

static int is_authentic(const hearing *h, const uint8_t *data, const said *s)
{
    uint8_t tag[DTSA_TAG_BYTES], differs = 0;
    make_tag(h, data, s->frame_length, s->slot, tag);
    for (int i = 0; i < DTSA_TAG_BYTES; i++)
        differs |= (uint8_t)(tag[i] ^ s->frame[s->frame_length + i]);
    return !differs;
}

verdict hearing_read(const hearing *h, const uint8_t *data, long length, said *out)
{
    const uint8_t *frame = data + h->head;
    if (h->agreed == WITH_MAGIC && (length < 3 || memcmp(data, h->header, 3))) return NOT_OURS;
    if (length < h->agreed) return WRONG_LENGTH;
    if (memcmp(data, h->header, (size_t)h->agreed)) return OTHER_SETTINGS;
    if (length != h->length) return WRONG_LENGTH;
    const int profile = frame[0] & 0xf;
    if (length - h->head < NAMED || frame[0] >> 4 != FRAME_VERSION || profile >= DTSA_PROFILE_COUNT)
        return NO_FRAME;
    *out = (said){.sender = profile == DTSA_PROFILE_EXTENDED ? frame[1] : word(frame + 1),
                  .slot = (int64_t)((uint32_t)word(frame + 4) | (uint32_t)word(frame + 6) << 16),
                  .late = h->late_bytes ? (int64_t)word(data + h->agreed) * UNIT : 0,
                  .frame = frame,
                  .frame_length = length - h->head};
    if (out->sender < 1 || out->sender > h->agents) return UNKNOWN_AGENT;
    if (h->key_length) {
        out->frame_length -= DTSA_TAG_BYTES;
        if (out->frame_length < 1 || !is_authentic(h, data, out)) return REJECTED;
    }
    for (int i = 0; i < h->peers; i++) {
        const uint8_t *at = data + h->agreed + h->late_bytes + 4 * i;
        out->peers[i] = (peer){word(at), (int64_t)(int16_t)word(at + 2) * UNIT};
    }
    return TAKEN;
}

/* Nothing else may say what time it is. What holders of the key seal is one. */
static int is_frame(const hearing *h, const said *s)
{
    dtsa_frame f;
    return h->key_length ||
           frame_decode(s->frame, s->frame_length - h->own_bytes, h->position_step, &f) == FRAME_OK;
}

/* ---- how much longer frames are under way than supposed ---- */

static void pair_is(delays *d, int k, int64_t total)
{
    int at = 0;
    if (d->known[k] & SUM) {
        while (d->sums[at] < d->sum[k]) at++;
        memmove(d->sums + at, d->sums + at + 1, sizeof *d->sums * (size_t)(--d->count - at));
    }
    d->known[k] |= SUM;
    d->sum[k] = total;
    for (at = d->count++; at > 0 && d->sums[at - 1] > total; at--) d->sums[at] = d->sums[at - 1];
    d->sums[at] = total;
}

static void delay_hear(hearing *h, const said *s, int64_t offset)
{
    delays *d = &h->delay;
    const int k = s->sender - 1;
    d->hears[k] = limited(offset, d->limit);
    d->known[k] |= HEARS;
    for (int i = 0; i < PEERS; i++) {
        if (s->peers[i].id != h->self + 1) continue;
        d->says[k] = limited(s->peers[i].late, d->limit);
        d->known[k] |= SAYS;
    }
    if (d->known[k] & SAYS) pair_is(d, k, d->hears[k] + d->says[k]);
    if (!d->count) return;
    const int64_t twice = d->sums[d->count / 2] + d->sums[(d->count - 1) / 2];
    d->error += floor_div(limited(floor_div(twice, 4) - d->error, STEP), SHARE);
}

static void delay_moved(hearing *h, int64_t by)
{
    delays *d = &h->delay;
    for (int k = 0; by && k < h->agents; k++) {
        if (d->known[k] & HEARS) d->hears[k] -= by;
        if (d->known[k] & SAYS) d->says[k] += by;
    }
}

static void delay_reset(hearing *h)
{
    memset(h->delay.known, 0, (size_t)h->agents);
    h->delay.count = 0;
}

static int is_told(const hearing *h, int k, int64_t slot)
{
    return h->delay.known[k] & HEARS && contacts_hears(&h->contact, k, slot);
}

/* What the next datagram says: the others in turn, the last one again. */
static void delay_tell(hearing *h, int64_t slot, peer told[PEERS])
{
    const delays *d = &h->delay;
    int heard = 0, count, index = 0;
    for (int k = 0; k < h->agents; k++) heard += is_told(h, k, slot);
    count = heard < h->peers ? heard : h->peers;
    for (int k = 0; k < h->agents && count; k++) {
        if (!is_told(h, k, slot)) continue;
        const int place = (int)((index++ - d->turn % heard + heard) % heard);
        if (place < count) told[place] = (peer){k + 1, d->hears[k]};
    }
    h->delay.turn += count > 1 ? count - 1 : count;
}

static void put(uint8_t *at, int64_t time, int64_t least, int64_t most)
{
    const int64_t units = floor_div(time, UNIT);
    const uint64_t value = (uint64_t)(units < least ? least : units > most ? most : units);
    at[0] = (uint8_t)value;
    at[1] = (uint8_t)(value >> 8);
}

void hearing_wrap(hearing *h, const uint8_t *frame, int64_t slot, int64_t late, uint8_t *out)
{
    const long length = h->length - h->head - (h->key_length ? DTSA_TAG_BYTES : 0);
    peer told[PEERS] = {{0, 0}};
    delay_tell(h, slot, told);
    memcpy(out, h->header, (size_t)h->agreed);
    if (h->late_bytes) put(out + h->agreed, late, 0, 0xffff);
    for (int i = 0; i < h->peers; i++) {
        uint8_t *at = out + h->agreed + h->late_bytes + 4 * i;
        at[0] = (uint8_t)told[i].id;
        at[1] = (uint8_t)(told[i].id >> 8);
        put(at + 2, told[i].late, -0x8000, 0x7fff);
    }
    memcpy(out + h->head, frame, (size_t)length);
    if (h->key_length) make_tag(h, out, length, slot, out + h->head + length);
}

/* ---- who hears whom, and when ---- */

static void contacts_said(hearing *h, const said *s)
{
    int names[PEERS], count = 0;
    for (int i = 0; i < PEERS; i++)
        if (s->peers[i].id) names[count++] = s->peers[i].id;
    contacts_hear(&h->contact, s->sender, s->slot, s->frame, names, count);
}

static void note_time(hearing *h, int64_t off)
{
    if (off < 0) off = -off;
    if (h->base.state == DTSA_LISTENING || off > NEAR_SLOTS * h->slot_ns) return;
    h->timed++;
    h->off += off > h->slot_ns / 4;
}

/* ---- slots ---- */

int slots_hear(hearing *h, int64_t slot, int64_t start)
{
    dtsa_timebase *b = &h->base;
    const int outcome = dtsa_timebase_hear(b, slot, start);
    if (outcome == DTSA_ALIGNED && b->aligner.ignored_in_a_row >= DOUBTS) {
        dtsa_align_reset(&b->aligner);
        b->state = DTSA_LISTENING; /* for this frame */
        dtsa_timebase_hear(b, slot, start);
        h->corrected++;
    }
    return outcome;
}

verdict hearing_take(hearing *h, const uint8_t *data, long length, int64_t arrival, said *out,
                     int *restarted)
{
    const verdict fault = hearing_read(h, data, length, out);
    *restarted = 0;
    if (fault) return fault;
    if (!is_frame(h, out)) return NO_FRAME;
    const int k = out->sender - 1;
    if (k == h->self) return OWN_NAME;
    if (h->last[k] == out->slot && h->base.state != DTSA_LISTENING) return REPEATED;
    const int64_t began = clock_local(&h->clock, arrival) - h->flight - out->late;
    const int64_t before = dtsa_timebase_slot_start(&h->base, out->slot);
    note_time(h, began - h->delay.error - before);
    const int outcome = slots_hear(h, out->slot, began - h->delay.error);
    if (outcome == DTSA_FOREIGN) {
        contacts_see(&h->contact, out->sender, out->slot, dtsa_timebase_slot(&h->base, began));
        return OTHER_TIME;
    }
    h->last[k] = out->slot;
    if (outcome == DTSA_RESTARTED) {
        *restarted = 1;
        delay_reset(h);
        contacts_reset(&h->contact, out->slot);
    } else {
        delay_hear(h, out, began - before);
        delay_moved(h, dtsa_timebase_slot_start(&h->base, out->slot) - before);
    }
    contacts_said(h, out);
    return TAKEN;
}

void hearing_lay(hearing *h, int64_t *memory, contact *of)
{
    const size_t n = (size_t)h->agents;
    h->contact.agents = h->agents;
    h->contact.self = h->self;
    h->contact.peers = h->peers;
    h->contact.of = of;
    contacts_clear(&h->contact);
    h->last = memory;
    h->delay.hears = memory + n;
    h->delay.says = memory + 2 * n;
    h->delay.sum = memory + 3 * n;
    h->delay.sums = memory + 4 * n;
    h->delay.known = (uint8_t *)(memory + 5 * n);
    for (size_t k = 0; k < n; k++) h->last[k] = -1;
}

int hearing_open(hearing *h)
{
    const size_t n = (size_t)h->agents;
    h->memory = calloc(6 * n, sizeof *h->memory);
    h->contact.of = calloc(n, sizeof *h->contact.of);
    if (!h->memory || !h->contact.of) return hearing_close(h), 0;
    hearing_lay(h, h->memory, h->contact.of);
    return 1;
}

void hearing_close(hearing *h)
{
    free(h->memory);
    free(h->contact.of);
}
