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

static int times_length(const dtsa_link *link)
{
    return (link->says_late ? 2 : 0) + 4 * link->names;
}

int datagram_head(const dtsa_link *link) { return link->header_length + times_length(link); }

int dtsa_datagram_length(const dtsa_station_settings *s)
{
    return datagram_head(&s->link) + s->frame_length + (s->key ? DTSA_TAG_BYTES : 0);
}

/* The tag covers the frame and the times before it. */
static void make_tag(const dtsa_station_settings *s, const uint8_t *data, uint32_t slot,
                     uint8_t tag[DTSA_TAG_BYTES])
{
    uint8_t covered[DTSA_DATAGRAM_MAX];
    const int head = datagram_head(&s->link), times = times_length(&s->link);
    memcpy(covered, data + head, (size_t)s->frame_length);
    memcpy(covered + s->frame_length, data + s->link.header_length, (size_t)times);
    dtsa_tag(s->key, s->key_length, s->session, slot, covered, s->frame_length + times, tag);
}

static int is_authentic(const dtsa_station_settings *s, const uint8_t *data, uint32_t slot)
{
    const uint8_t *given = data + datagram_head(&s->link) + s->frame_length;
    uint8_t tag[DTSA_TAG_BYTES], differs = 0;
    make_tag(s, data, slot, tag);
    for (int i = 0; i < DTSA_TAG_BYTES; i++) differs |= (uint8_t)(tag[i] ^ given[i]);
    return !differs;
}

dtsa_verdict dtsa_datagram_read(const dtsa_station_settings *s, const uint8_t *data, long length,
                                dtsa_datagram *out)
{
    const dtsa_link *link = &s->link;
    const int agreed = link->header_length;
    const uint8_t *frame = data + datagram_head(link);
    dtsa_frame f;
    if (agreed == DTSA_HEADER_MAX && (length < 3 || memcmp(data, link->header, 3)))
        return DTSA_NOT_OURS;
    if (length < agreed) return DTSA_WRONG_LENGTH;
    if (memcmp(data, link->header, (size_t)agreed)) return DTSA_OTHER_SETTINGS;
    if (length != dtsa_datagram_length(s)) return DTSA_WRONG_LENGTH;
    const int profile = frame[0] & 0xf;
    if (s->frame_length < LEAST_FRAME || frame[0] >> 4 != FRAME_VERSION ||
        profile >= DTSA_PROFILE_COUNT)
        return DTSA_NO_FRAME;
    *out = (dtsa_datagram){
        .sender = profile == DTSA_PROFILE_EXTENDED ? frame[1] : get_word(frame + 1),
        .slot = (uint32_t)get_word(frame + 4) | (uint32_t)get_word(frame + 6) << 16,
        .late_ns = link->says_late ? (int64_t)get_word(data + agreed) * LATE_UNIT_NS : 0,
        .frame = frame,
        .frame_length = s->frame_length};
    if (out->sender < 1 || out->sender > s->agents) return DTSA_UNKNOWN_AGENT;
    if (s->key && !is_authentic(s, data, out->slot)) return DTSA_REJECTED;
    /* Nothing else may show what time it is. What holders of the key sign is a frame. */
    if (out->slot >= s->slot_cycle ||
        (!s->key && frame_decode(frame, s->frame_length - s->own_bytes, s->position_step, &f)))
        return DTSA_NO_FRAME;
    for (int i = 0; i < link->names; i++) {
        const uint8_t *at = data + agreed + (link->says_late ? 2 : 0) + 4 * i;
        out->names[i] =
            (dtsa_named){get_word(at), (int64_t)(int16_t)get_word(at + 2) * LATE_UNIT_NS};
    }
    return DTSA_ACCEPTED;
}

int dtsa_datagram_write(const dtsa_station_settings *s, const uint8_t *frame, uint32_t slot,
                        int64_t late_ns, const dtsa_named names[DTSA_NAMES_MAX], uint8_t *out)
{
    const dtsa_link *link = &s->link;
    uint8_t *at = out + link->header_length;
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
    memcpy(at, frame, (size_t)s->frame_length);
    if (s->key) make_tag(s, out, slot, at + s->frame_length);
    return dtsa_datagram_length(s);
}

/* FNV-1a: tells an echo of an own datagram from one of another sender with the same id. */
uint64_t datagram_hash(uint64_t hash, const uint8_t *data, long length)
{
    for (long i = 0; i < length; i++) hash = (hash ^ data[i]) * HASH_PRIME;
    return hash;
}
