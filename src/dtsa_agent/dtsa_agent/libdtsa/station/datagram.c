/* Datagrams: which swarm they are of, what they say, and whether their sender holds the key. */
#include <string.h>

#include "station.h"

enum { LATE_UNIT_NS = 10000, LEAST_FRAME = 8 };

static int get_word(const uint8_t *at) { return at[0] | at[1] << 8; }

static void put_time(uint8_t *at, int64_t time_ns, int64_t least, int64_t most)
{
    const int64_t units = floor_div(time_ns, LATE_UNIT_NS);
    const uint64_t value = (uint64_t)(units < least ? least : units > most ? most : units);
    at[0] = (uint8_t)value;
    at[1] = (uint8_t)(value >> 8);
}

/* The tag covers the frame and the times before it. */
static void make_tag(const dtsa_station *s, const uint8_t *data, long frame_length, uint32_t slot,
                     uint8_t tag[DTSA_TAG_BYTES])
{
    const dtsa_station_settings *c = &s->settings;
    uint8_t covered[DTSA_DATAGRAM_MAX];
    const long times = s->head_length - c->link.header_length;
    memcpy(covered, data + s->head_length, (size_t)frame_length);
    memcpy(covered + frame_length, data + c->link.header_length, (size_t)times);
    dtsa_tag(c->key, c->key_length, c->session, slot, covered, frame_length + times, tag);
}

static int is_authentic(const dtsa_station *s, const uint8_t *data, const parsed_datagram *d)
{
    uint8_t tag[DTSA_TAG_BYTES], differs = 0;
    make_tag(s, data, d->frame_length, d->slot, tag);
    for (int i = 0; i < DTSA_TAG_BYTES; i++)
        differs |= (uint8_t)(tag[i] ^ d->frame[d->frame_length + i]);
    return !differs;
}

dtsa_verdict datagram_parse(const dtsa_station *s, const uint8_t *data, long length,
                            parsed_datagram *out)
{
    const dtsa_link *link = &s->settings.link;
    const int agreed = link->header_length;
    const uint8_t *frame = data + s->head_length;
    if (agreed == DTSA_HEADER_MAX && (length < 3 || memcmp(data, link->header, 3)))
        return DTSA_NOT_OURS;
    if (length < agreed) return DTSA_WRONG_LENGTH;
    if (memcmp(data, link->header, (size_t)agreed)) return DTSA_OTHER_SETTINGS;
    if (length != s->datagram_length) return DTSA_WRONG_LENGTH;
    const int profile = frame[0] & 0xf;
    if (length - s->head_length < LEAST_FRAME || frame[0] >> 4 != FRAME_VERSION ||
        profile >= DTSA_PROFILE_COUNT)
        return DTSA_NO_FRAME;
    *out = (parsed_datagram){
        .sender = profile == DTSA_PROFILE_EXTENDED ? frame[1] : get_word(frame + 1),
        .slot = (uint32_t)get_word(frame + 4) | (uint32_t)get_word(frame + 6) << 16,
        .late_ns = link->says_late ? (int64_t)get_word(data + agreed) * LATE_UNIT_NS : 0,
        .frame = frame,
        .frame_length = length - s->head_length};
    if (out->sender < 1 || out->sender > s->settings.agents) return DTSA_UNKNOWN_AGENT;
    if (s->settings.key) {
        out->frame_length -= DTSA_TAG_BYTES;
        if (out->frame_length < 1 || !is_authentic(s, data, out)) return DTSA_REJECTED;
    }
    if (out->slot >= s->settings.slot_cycle) return DTSA_NO_FRAME;
    for (int i = 0; i < link->names; i++) {
        const uint8_t *at = data + agreed + (link->says_late ? 2 : 0) + 4 * i;
        out->names[i] =
            (named_peer){get_word(at), (int64_t)(int16_t)get_word(at + 2) * LATE_UNIT_NS};
    }
    return DTSA_ACCEPTED;
}

/* Nothing else may show what time it is. What holders of the key sign is a frame. */
int datagram_has_frame(const dtsa_station *s, const parsed_datagram *d)
{
    dtsa_frame f;
    return s->settings.key ||
           frame_decode(d->frame, d->frame_length - s->settings.own_bytes,
                        s->settings.position_step, &f) == FRAME_OK;
}

void datagram_write(dtsa_station *s, int64_t now, int64_t late_ns, uint8_t *out)
{
    const dtsa_link *link = &s->settings.link;
    const long length = s->settings.frame_length;
    uint8_t *at = out + link->header_length;
    named_peer names[DTSA_NAMES_MAX] = {{0, 0}};
    delay_name(s, now, names);
    memcpy(out, link->header, (size_t)link->header_length);
    if (link->says_late) {
        put_time(at, late_ns, 0, 0xffff);
        at += 2;
    }
    for (int i = 0; i < link->names; i++, at += 4) {
        at[0] = (uint8_t)names[i].id;
        at[1] = (uint8_t)(names[i].id >> 8);
        put_time(at + 2, names[i].late_ns, -0x8000, 0x7fff);
    }
    memcpy(at, s->frame, (size_t)length);
    if (s->settings.key)
        make_tag(s, out, length, (uint32_t)((uint64_t)s->slot % s->settings.slot_cycle), at + length);
}

/* FNV-1a: tells an echo of an own datagram from one of another sender with the same id. */
uint64_t datagram_hash(const uint8_t *data, long length)
{
    uint64_t hash = 0xcbf29ce484222325ULL;
    for (long i = 0; i < length; i++) hash = (hash ^ data[i]) * 0x100000001b3ULL;
    return hash;
}
