/* Fuzzed: a station with an agent of libdtsa behind it. The first bytes are settings. Then each event
 * is a datagram (any bytes, or with a good header, or whole with a right tag, of any sender, slot and
 * names), steps until nothing is due, a port that refuses, a leave, or a clock that steps. Both live
 * in exactly the memory that they ask for. */
#include <limits.h>
#include <stdlib.h>
#include <string.h>

#include "dtsa_station.h"
#include "frame.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

enum { AGENTS = 12, SPIN_LIMIT = 100 };

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

static void configure(input *in, dtsa_config *c, double *places)
{
    memset(c, 0, sizeof *c);
    c->agents = 1 + (int)(next(in, 1) % AGENTS);
    c->policy = next(in, 1) & 1 ? DTSA_POLICY_LEASE : DTSA_POLICY_TDMA;
    c->profile = c->policy == DTSA_POLICY_LEASE ? DTSA_PROFILE_EXTENDED : (int)(next(in, 1) & 1);
    c->estimator = DTSA_ESTIMATE_LINEAR;
    c->avoider = DTSA_AVOID_NONE;
    c->slot_s = 0.01;
    c->steps = c->c_r = 1;
    c->r_min = 0.3;
    c->position_step = 0.002;
    c->gossip = 1;
    c->targets_known = (int)(next(in, 1) & 1);
    c->avoid.v_max = 1.0;
    c->lease = (dtsa_lease_config){.anchor_every = 1 + (int)(next(in, 1) % 5),
                                   .open_every = (int)(next(in, 1) % 12),
                                   .adoption = 1,
                                   .depth_rate = 0.2,
                                   .share = 1.0};
    c->lease.main_every = c->lease.anchor_every * (1 + (int)(next(in, 1) % 3));
    for (int i = 0; i < 6 * c->agents; i++) places[i] = (int)(i % 7) * 0.7;
    c->start = places;
    c->target = places + 3 * c->agents;
}

static void settle(input *in, const dtsa_config *c, dtsa_station_settings *s)
{
    static const uint8_t KEY[32] = {1, 2, 3};
    static const int HEADERS[] = {DTSA_HEADER_MAX, 2, 4, 0};
    const int64_t kind = next(in, 1);
    memset(s, 0, sizeof *s);
    s->agents = c->agents;
    s->id = 1 + (int)(next(in, 1) % c->agents);
    s->anchor_every = c->lease.anchor_every;
    s->main_every = c->lease.main_every;
    s->slot_cycle = dtsa_slot_cycle(c);
    s->extended = c->profile == DTSA_PROFILE_EXTENDED;
    s->own_bytes = 0;
    s->frame_length = frame_length(c->profile);
    s->position_step = c->position_step;
    s->slot_ns = 300000 + next(in, 4) % 999700000;
    s->seed = (uint64_t)next(in, 1);
    s->quorum = (int)(next(in, 1) % 4) - 2;
    s->quorum_share = 0.5;
    s->key = kind & 1 ? KEY : NULL;
    s->key_length = 32;
    s->early_count = 1 + (int)(kind >> 4);
    s->begins = kind >> 1 & 1;
    s->origin_ns = next(in, 6) - next(in, 6);
    s->link = (dtsa_link){.header = "DT\1\0abc",
                          .header_length = HEADERS[kind >> 2 & 3],
                          .says_late = (int)(next(in, 1) & 1),
                          .names = (int)(next(in, 1) % (DTSA_NAMES_MAX + 1)),
                          .flight_ns = next(in, 3),
                          .trust_ns = 1 + next(in, 3)};
}

/* A datagram as another agent sends it: its frame is any bytes, but for what shows sender and slot. */
static long write_datagram(input *in, const dtsa_station_settings *s, const dtsa_config *c,
                           uint64_t near, uint8_t *out)
{
    uint8_t frame[DTSA_DATAGRAM_MAX] = {0};
    dtsa_named names[DTSA_NAMES_MAX] = {{0, 0}};
    const int64_t kind = next(in, 1);
    const uint32_t slot = kind & 1 ? (uint32_t)next(in, 4)
                                   : (uint32_t)((near + (uint64_t)(kind >> 1 & 3)) % s->slot_cycle);
    for (int i = 0; i < s->frame_length; i++) frame[i] = (uint8_t)(kind & 8 ? next(in, 1) : 0);
    frame[0] = (uint8_t)(FRAME_VERSION << 4 | c->profile);
    frame[1] = (uint8_t)(1 + next(in, 1) % (s->agents + 1));
    if (!s->extended) frame[2] = 0;
    for (int i = 0; i < 4; i++) frame[4 + i] = (uint8_t)(slot >> 8 * i);
    for (int i = 0; i < s->link.names; i++)
        names[i] = (dtsa_named){(int)(next(in, 1) % (AGENTS + 2)), next(in, 2) * 1000 - 30000000};
    return dtsa_datagram_write(s, frame, slot, next(in, 2) * 1000, names, out);
}

static void receive(input *in, dtsa_station *station, const dtsa_station_settings *s,
                    const dtsa_config *c, int64_t kind, int64_t now)
{
    uint8_t made[DTSA_DATAGRAM_MAX];
    const int64_t slot = dtsa_station_slot(station);
    long length = dtsa_datagram_length(s);
    if (kind & 8)
        length = write_datagram(in, s, c, slot < 0 ? 0 : (uint64_t)slot, made);
    else
        for (long i = 0; i < length; i++) made[i] = (uint8_t)next(in, 1);
    if (kind & 16) memcpy(made, s->link.header, (size_t)s->link.header_length);
    if (kind & 32) length = next(in, 2) % (length + 1);
    uint8_t *exact = malloc((size_t)length + !length);
    if (!exact) abort();
    memcpy(exact, made, (size_t)length);
    dtsa_datagram d;
    const dtsa_verdict read = dtsa_datagram_read(s, exact, length, &d);
    const dtsa_verdict verdict = dtsa_station_receive(station, exact, length, now);
    check(verdict < DTSA_VERDICT_COUNT);
    check(!read || verdict == read);
    check(read || (d.sender >= 1 && d.sender <= s->agents && d.slot < s->slot_cycle &&
                   d.frame + d.frame_length <= exact + length));
    free(exact);
}

static void step(input *in, dtsa_station *station, const dtsa_station_settings *s, int64_t now)
{
    for (int k = 0; k < SPIN_LIMIT; k++) {
        int length = 0;
        uint8_t *out = malloc((size_t)dtsa_datagram_length(s));
        if (!out) abort();
        const int64_t due = dtsa_station_step(station, now, out, &length);
        check(length == 0 || length == dtsa_datagram_length(s));
        if (length) dtsa_station_sent(station, now, next(in, 1) & 7);
        free(out);
        if (due > now) return;
    }
}

static void check_status(const dtsa_station *station, const dtsa_station_settings *s)
{
    dtsa_station_status n;
    dtsa_station_get_status(station, &n);
    check(n.both >= 0 && n.both <= n.hears && n.hears <= n.others && n.others < s->agents);
    check(n.heard_by >= n.both && n.heard_by <= n.others && n.in_step <= s->agents);
    check(n.hovers >= 0 && n.hovers < DTSA_HOVER_COUNT && n.state <= DTSA_JOINED);
    check(n.hovers != DTSA_FLIES || n.both >= n.needed);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static double places[6 * AGENTS];
    input in = {data, data + size};
    dtsa_config c;
    dtsa_station_settings s;
    configure(&in, &c, places);
    settle(&in, &c, &s);
    const size_t agent_bytes = dtsa_agent_bytes(&c), bytes = dtsa_station_bytes(&s);
    check(agent_bytes && bytes);
    int64_t now = 5000000000000;
    dtsa_agent *agent = dtsa_agent_start(malloc(agent_bytes), agent_bytes, &c, s.id);
    check(agent != NULL);
    const dtsa_station_agent behind = dtsa_station_agent_of(agent);
    dtsa_station *station = dtsa_station_start(malloc(bytes), bytes, &s, &behind, now);
    check(station != NULL);
    while (in.at < in.end) {
        const int64_t kind = next(&in, 1);
        switch (kind & 7) {
        case 0:
            now += next(&in, 4);
            break;
        case 1:
            now += s.slot_ns;
            break;
        case 2:
            now -= next(&in, 4);
            break;
        case 3:
            dtsa_station_leave(station);
            break;
        default:
            receive(&in, station, &s, &c, kind, now);
        }
        if (kind & 64) step(&in, station, &s, now);
        dtsa_station_awaits_frame(station, now);
        check_status(station, &s);
    }
    free(station);
    free(agent);
    return 0;
}
