/* The extended frame: the paper's state, and three sections about others. Layout in
 * docs/reference/protocol.md.
 *
 *   0      version (high nibble), profile 2 (low nibble)
 *   1      sender's id, 1..254
 *   2      c_s, 0..253; 255: the sender leaves with this frame
 *   3      bit 0: c_r is not 0; bit 1: in probation;
 *          bits 2-3, 4-5, 6-7: kinds of the three sections
 *   4-22   slot, position, velocity, intended velocity as in profile paper with intent
 *   23-33, 34-44, 45-55   sections:
 *     kind 0, gossip: id (0: empty), age << 1 | c_r is not 0, position 3 x 14 bits at twice the
 *       frame's step (4 mm), velocity 3 x 10 bits at 2 cm/s
 *     kind 1, leases: a byte a turn (0: none, id of the lessee, 255: open)
 *     kind 2, relay: 24 bits, bit d - 1: turn slot + d is leased; then at most 8 lessees
 *     kind 3, far: id of a lessee; 80 bits, bit d - 25: turn slot + d is handed on to it
 */
#include <math.h>
#include <string.h>

#include "frame.h"

enum { KIND_GOSSIP, KIND_LEASES, KIND_RELAY, KIND_FAR };

static const double VELOCITY_STEP = 0.02;

/* Gossip has two bits less for a coordinate than the sender's own state: twice the step, half the
 * extent. */
static double gossip_step(double position_step) { return 2.0 * position_step; }

int gossip_fits(const double p[3], const double v[3], double position_step)
{
    const double far = ((1 << 13) - 2) * gossip_step(position_step),
                 fast = ((1 << 9) - 2) * VELOCITY_STEP;
    for (int i = 0; i < 3; i++)
        if (!(fabs(p[i]) <= far && fabs(v[i]) <= fast)) return 0;
    return 1;
}

static void put_bits(uint8_t *out, int at, int bits, uint64_t value)
{
    for (int i = 0; i < bits; i++, at++)
        if (value >> i & 1) out[at >> 3] |= (uint8_t)(1u << (at & 7));
}

static int64_t get_signed(const uint8_t *in, int at, int bits)
{
    uint64_t word = 0;
    const int first = at >> 3, last = (at + bits - 1) >> 3;
    for (int i = last; i >= first; i--) word = word << 8 | in[i];
    word = word >> (at & 7) & ((1ULL << bits) - 1);
    const uint64_t top = 1ULL << (bits - 1);
    return (int64_t)(word ^ top) - (int64_t)top;
}

static void put_gossip(const gossip_entry *g, double step, uint8_t *out)
{
    out[0] = (uint8_t)g->id;
    out[1] = (uint8_t)(g->age << 1 | (g->c_r != 0));
    for (int i = 0; i < 3; i++) {
        put_bits(out + 2, 14 * i, 14, (uint64_t)quantise(g->p[i], step, 14));
        put_bits(out + 2, 42 + 10 * i, 10, (uint64_t)quantise(g->v[i], VELOCITY_STEP, 10));
    }
}

static int get_gossip(const uint8_t *in, double step, gossip_entry *g)
{
    g->id = in[0];
    if (!g->id) {
        for (int i = 1; i < SECTION_BYTES; i++)
            if (in[i]) return FRAME_BAD_FIELD;
        return FRAME_OK;
    }
    g->age = in[1] >> 1;
    g->c_r = in[1] & 1;
    if (g->id > DTSA_EXTENDED_AGENTS_MAX || g->age == 0) return FRAME_BAD_FIELD;
    for (int i = 0; i < 3; i++) {
        g->p[i] = (double)get_signed(in + 2, 14 * i, 14) * step;
        g->v[i] = (double)get_signed(in + 2, 42 + 10 * i, 10) * VELOCITY_STEP;
    }
    return FRAME_OK;
}

static int get_relay(const uint8_t *in, extended_frame *e)
{
    e->relay_mask = (uint32_t)in[0] | (uint32_t)in[1] << 8 | (uint32_t)in[2] << 16;
    int count = 0;
    for (int d = 0; d < RELAY_REACH; d++) count += e->relay_mask >> d & 1;
    if (count > RELAY_IDS) return FRAME_BAD_FIELD;
    for (int i = 0; i < RELAY_IDS; i++) {
        e->relay_ids[i] = in[3 + i];
        if ((e->relay_ids[i] != 0) != (i < count)) return FRAME_BAD_FIELD;
    }
    return FRAME_OK;
}

static int get_far(const uint8_t *in, extended_frame *e)
{
    int any = 0;
    e->far_id = in[0];
    memcpy(e->far_mask, in + 1, FAR_BYTES);
    for (int i = 0; i < FAR_BYTES; i++) any |= e->far_mask[i];
    return any && e->far_id && e->far_id <= DTSA_EXTENDED_AGENTS_MAX ? FRAME_OK : FRAME_BAD_FIELD;
}

/* Whether all that a frame says of others is within range. */
static int sayable(const extended_frame *e)
{
    int relayed = 0, last = 0, far = 0;
    if (e->c_s < 0 || e->c_s >= DTSA_EXTENDED_AGENTS_MAX || e->gossip_count < 0 ||
        e->gossip_count > SECTIONS || e->lease_count < 0 ||
        e->lease_count > SECTIONS * SECTION_BYTES || e->relay_mask >> RELAY_REACH)
        return 0;
    for (int i = 0; i < e->gossip_count; i++) {
        const gossip_entry *g = &e->gossip[i];
        if (g->id < 1 || g->id > DTSA_EXTENDED_AGENTS_MAX || g->age < 1 || g->age > GOSSIP_AGE_MAX)
            return 0;
        for (int axis = 0; axis < 3; axis++)
            if (g->p[axis] != g->p[axis] || g->v[axis] != g->v[axis]) return 0;
    }
    for (int i = 0; i < FAR_BYTES; i++) far |= e->far_mask[i];
    if (!far != !e->far_id || e->far_id > DTSA_EXTENDED_AGENTS_MAX) return 0;
    for (int d = 0; d < RELAY_REACH; d++) relayed += e->relay_mask >> d & 1;
    while (last < RELAY_IDS && e->relay_ids[last]) last++;
    return relayed <= RELAY_IDS && relayed == last;
}

int extended_encode(const extended_frame *e, double position_step, uint8_t *out)
{
    uint8_t kinds[SECTIONS];
    int section = 0;
    if (!sayable(e) || !frame_encode(&e->own, position_step, out)) return 0;
    uint8_t *at = out + EXTENDED_HEAD;
    out[2] = e->leaving ? FRAME_LEAVES : (uint8_t)e->c_s;
    for (int i = 0; i < e->lease_count; i += SECTION_BYTES, at += SECTION_BYTES) {
        if (section == SECTIONS) return 0;
        kinds[section++] = KIND_LEASES;
        const int count = e->lease_count - i < SECTION_BYTES ? e->lease_count - i : SECTION_BYTES;
        memcpy(at, e->leases + i, (size_t)count);
    }
    if (e->relay_mask) {
        if (section == SECTIONS) return 0;
        kinds[section++] = KIND_RELAY;
        for (int i = 0; i < 3; i++) at[i] = (uint8_t)(e->relay_mask >> 8 * i);
        memcpy(at + 3, e->relay_ids, RELAY_IDS);
        at += SECTION_BYTES;
    }
    if (e->far_id) {
        if (section == SECTIONS) return 0;
        kinds[section++] = KIND_FAR;
        at[0] = e->far_id;
        memcpy(at + 1, e->far_mask, FAR_BYTES);
        at += SECTION_BYTES;
    }
    for (int i = 0; i < e->gossip_count; i++, at += SECTION_BYTES) {
        if (section == SECTIONS) return 0;
        kinds[section++] = KIND_GOSSIP;
        put_gossip(&e->gossip[i], gossip_step(position_step), at);
    }
    while (section < SECTIONS) kinds[section++] = KIND_GOSSIP;
    out[3] = (uint8_t)(out[3] | (e->probation != 0) << 1 | kinds[0] << 2 | kinds[1] << 4 |
                       kinds[2] << 6);
    return EXTENDED_LENGTH;
}

int extended_decode(const uint8_t *data, long length, double position_step, extended_frame *e)
{
    const int status = frame_decode(data, length, position_step, &e->own);
    if (status != FRAME_OK) return status;
    if (e->own.profile != DTSA_PROFILE_EXTENDED) return FRAME_BAD_HEADER;
    e->leaving = frame_condition_of(data).leaves;
    e->c_s = e->leaving ? 0 : data[2];
    if (e->c_s == 254) return FRAME_BAD_FIELD;
    e->probation = frame_condition_of(data).on_probation;
    e->gossip_count = e->lease_count = 0;
    e->relay_mask = 0;
    e->far_id = 0;
    memset(e->far_mask, 0, FAR_BYTES);
    int relays = 0;
    for (int i = 0; i < SECTIONS; i++) {
        const uint8_t *at = data + EXTENDED_HEAD + i * SECTION_BYTES;
        int bad = FRAME_OK;
        switch (data[3] >> (2 + 2 * i) & 3) {
        case KIND_GOSSIP:
            bad = get_gossip(at, gossip_step(position_step), &e->gossip[e->gossip_count]);
            e->gossip_count += bad == FRAME_OK && at[0];
            break;
        case KIND_LEASES:
            memcpy(e->leases + e->lease_count, at, SECTION_BYTES);
            e->lease_count += SECTION_BYTES;
            break;
        case KIND_RELAY:
            bad = relays++ ? FRAME_BAD_FIELD : get_relay(at, e);
            break;
        default:
            bad = e->far_id ? FRAME_BAD_FIELD : get_far(at, e);
        }
        if (bad != FRAME_OK) return bad;
    }
    return FRAME_OK;
}
