/* Fuzzed: what an agent on a network makes of datagrams. The first bytes are settings; each
 * datagram has a length, a time and what is to be made of it before: bytes as they are, or a good
 * header, or a whole datagram with a right tag. */
#include <stdlib.h>
#include <string.h>

#include "frame.h"
#include "hearing.h"
#include "stamps.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

typedef struct input {
    const uint8_t *at, *end;
} input;

static int64_t next(input *in, int bytes)
{
    int64_t value = 0;
    for (; bytes > 0 && in->at < in->end; bytes--) value = value << 8 | *in->at++;
    return value;
}

static void check(int holds)
{
    if (!holds) abort();
}

static hearing *opened(input *in)
{
    static const int LENGTHS[] = {19, 23, EXTENDED_LENGTH};
    hearing *h = calloc(1, sizeof *h);
    const int64_t kind = next(in, 1);
    if (!h) abort();
    h->agents = 1 + (int)(next(in, 1) % 12);
    h->self = (int)(next(in, 1) % h->agents);
    h->agreed = kind >> 4 & 1 ? 2 : WITH_MAGIC; /* a port where bytes are dear, or a network */
    h->late_bytes = 2;
    h->peers = kind >> 4 & 1 ? 1 : PEERS;
    h->head = h->agreed + h->late_bytes + 4 * h->peers;
    memcpy(h->header, "DT\1\0abcd", (size_t)h->agreed);
    h->key_length = kind & 1 ? 32 : 0;
    h->position_step = 0.002;
    h->length = h->head + LENGTHS[(kind >> 1 & 3) % 3] + (kind & 1 ? DTSA_TAG_BYTES : 0);
    h->own_bytes = kind >> 3 & 1 ? 5 : 0;
    h->clock = (own_clock){next(in, 5), next(in, 5), next(in, 2) - 32768};
    dtsa_timebase_init(&h->base, h->agents, 1 + (int)(next(in, 1) & 7),
                       300000 + next(in, 4) % 999700000, h->self + 1, 1);
    h->delay.limit = h->base.slot_ns / 4;
    h->slot_ns = h->base.slot_ns;
    h->contact.moving = next(in, 1);
    h->contact.resting = next(in, 2);
    h->contact.named = next(in, 2);
    check(hearing_open(h));
    return h;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    input in = {data, data + size};
    hearing *h = opened(&in);
    stamp_clock stamps = {0};
    int64_t now = 5000000000000;
    while (in.at < in.end) {
        const int64_t kind = next(&in, 1);
        const long given = kind & 1 ? (long)next(&in, 2) % LONGEST : h->length;
        const long left = (long)(in.end - in.at);
        const long length = given < left ? given : left;
        uint8_t *datagram = malloc((size_t)length + 1), made[LONGEST];
        said s;
        int restarted;
        if (!datagram) abort();
        memcpy(datagram, in.at, (size_t)length);
        in.at += length;
        if (kind & 2 && length >= h->agreed) memcpy(datagram, h->header, (size_t)h->agreed);
        if (kind & 4 && length == h->length) {
            const uint8_t *frame = datagram + h->head;
            hearing_wrap(h, frame, (int64_t)frame[4] | frame[5] << 8, next(&in, 4), made);
            memcpy(datagram, made, (size_t)length);
        }
        now += next(&in, 3);
        const verdict v = hearing_take(h, datagram, length, now, &s, &restarted);
        check(v >= TAKEN && v < VERDICTS);
        check(v != TAKEN ||
              (length == h->length && s.sender >= 1 && s.sender <= h->agents &&
               s.sender != h->self + 1 && s.frame + s.frame_length <= datagram + length &&
               h->base.state == DTSA_JOINED));
        check(h->delay.count <= h->agents);
        const contact_count n = contacts_count(&h->contact, (int64_t)next(&in, 4), kind & 1);
        check(n.both >= 0 && n.both <= n.hears && n.hears <= n.there && n.there < h->agents);
        stamps_looked(&stamps, next(&in, 6), now);
        check(stamps_arrival(&stamps, next(&in, 6)) <= now);
        free(datagram);
    }
    hearing_close(h);
    free(h);
    return 0;
}
