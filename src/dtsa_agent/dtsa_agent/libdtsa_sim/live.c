/* Stations on virtual time. Events are ordered by time, then by the order in which they were made. */
#include "live.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core.h"
#include "station/station.h"

enum { WAKE, ARRIVE, BEGIN, END, INJECT, START, GOALS };
enum { QUEUE_LENGTH = 64, HISTORY_LENGTH = 256, SPIN_LIMIT = 20000 };
static const int64_t SECOND = 1000000000;

typedef struct event {
    int64_t at;
    uint64_t order;
    int kind, host, index, length; /* index: of a fault, or of a wake-up */
    uint8_t data[DTSA_DATAGRAM_MAX];
} event;

typedef struct queued {
    int64_t at;
    int length;
    uint8_t data[DTSA_DATAGRAM_MAX];
} queued;

typedef struct host {
    int id, on, token;
    dtsa_station *station;
    dtsa_agent *agent;
    void *memory, *agent_memory;
    int64_t time_ref, clock_ref, drift; /* of its clock */
    int64_t stalled_until;
    double position[3], velocity[3], home[3], away[3];
    queued *queue;
    int queue_count;
    int64_t sent_slot; /* of its last frame */
    int64_t sent_at;
    int64_t *received;            /* (hosts) when it got the last frame of each */
    int64_t wrong_ns, checked_at; /* flown without a quorum since it had one; time of the check */
} host;

typedef struct live {
    const live_flight *f;
    live_result *r;
    live_observer observer;
    void *context;
    int n, hosts; /* agents; with those of the same id twice */
    host *host;
    event **heap, **spare;
    int count, room, spares;
    uint64_t order, random;
    int64_t now;
    uint64_t active; /* faults */
    double loss, duplicate, corrupt;
    int64_t jitter;
    uint64_t cut[LIVE_HOSTS_MAX]; /* by receiver: senders that it does not hear */
    struct {
        int length, sender;
        uint8_t data[DTSA_DATAGRAM_MAX];
    } history[HISTORY_LENGTH];
    int64_t busy_until[LIVE_HOSTS_MAX]; /* by receiver: the medium is in use */
    event *last_arrival[LIVE_HOSTS_MAX];
    int64_t quorum_slack_ns;
    int failed;
} live;

/* ---- chance ---- */

static uint64_t draw(live *v) { return mix64(v->random += 0x9e3779b97f4a7c15ULL); }
static double uniform(live *v) { return (double)(draw(v) >> 11) / 9007199254740992.0; }
static int64_t below(live *v, int64_t n) { return n > 0 ? (int64_t)(uniform(v) * (double)n) : 0; }
static int happens(live *v, double share) { return share > 0.0 && uniform(v) < share; }

/* ---- clocks ---- */

static int64_t clock_of(const host *h, int64_t t)
{
    const int64_t d = t - h->time_ref;
    return h->clock_ref + d + d / 1000 * h->drift / 1000000;
}

static int64_t time_of(const host *h, int64_t clock)
{
    const int64_t d = clock - h->clock_ref;
    int64_t t = h->time_ref + d - d / 1000 * h->drift / (1000000 + h->drift / 1000);
    while (clock_of(h, t) < clock) t++;
    return t;
}

static void step_clock(live *v, host *h, int64_t by)
{
    h->clock_ref = clock_of(h, v->now) + by;
    h->time_ref = v->now;
}

/* ---- events ---- */

static int is_before(const event *a, const event *b)
{
    return a->at != b->at ? a->at < b->at : a->order < b->order;
}

/* index: of a fault, or of a wake-up. NULL, and the flight has failed, where there is no memory. */
static event *push(live *v, int64_t at, int kind, int host, int index)
{
    if (v->count == v->room) {
        const int room = v->room ? 2 * v->room : 1024;
        event **heap = realloc(v->heap, sizeof *heap * (size_t)room);
        event **spare = realloc(v->spare, sizeof *spare * (size_t)room);
        if (heap) v->heap = heap;
        if (spare) v->spare = spare;
        if (!heap || !spare) return v->failed = 1, NULL;
        v->room = room;
    }
    event *e = v->spares ? v->spare[--v->spares] : malloc(sizeof *e);
    if (!e) return v->failed = 1, NULL;
    e->at = at;
    e->order = v->order++;
    e->kind = kind;
    e->host = host;
    e->index = index;
    e->length = 0;
    int i = v->count++;
    for (; i && is_before(e, v->heap[(i - 1) / 2]); i = (i - 1) / 2)
        v->heap[i] = v->heap[(i - 1) / 2];
    v->heap[i] = e;
    return e;
}

static event *pop(live *v)
{
    event *top = v->heap[0], *last = v->heap[--v->count];
    int i = 0;
    for (;;) {
        int c = 2 * i + 1;
        if (c >= v->count) break;
        if (c + 1 < v->count && is_before(v->heap[c + 1], v->heap[c])) c++;
        if (!is_before(v->heap[c], last)) break;
        v->heap[i] = v->heap[c];
        i = c;
    }
    if (v->count) v->heap[i] = last;
    return top;
}

static void violate(live *v, int kind, int agent, int other)
{
    if (v->r->violation) return;
    v->r->violation = kind;
    v->r->agent = agent;
    v->r->other = other;
    v->r->at_ns = v->now;
}

static void tell(live *v, live_call call)
{
    if (v->observer) v->observer(v->context, &call);
}

/* ---- the medium ---- */

static void note_bytes(live *v, const uint8_t *data, int length)
{
    v->r->hash = (datagram_hash(v->r->hash, data, length) ^ (uint64_t)v->now) * HASH_PRIME;
}

static void deliver(live *v, int receiver, const uint8_t *data, int length, int64_t later)
{
    const live_flight *f = v->f;
    const int64_t most = f->jitter_ns > v->jitter ? f->jitter_ns : v->jitter;
    const int64_t at = v->now + f->latency_ns + later + below(v, most);
    if (f->airtime_ns) { /* both are lost where two overlap */
        event *last = v->last_arrival[receiver];
        if (at - f->airtime_ns < v->busy_until[receiver]) {
            if (last) last->length = 0;
            v->r->collided++;
            if (at > v->busy_until[receiver]) v->busy_until[receiver] = at;
            v->last_arrival[receiver] = NULL;
            return;
        }
        v->busy_until[receiver] = at;
    }
    event *e = push(v, at, ARRIVE, receiver, 0);
    if (!e) return;
    e->length = length;
    memcpy(e->data, data, (size_t)length);
    if (happens(v, v->corrupt)) e->data[below(v, length)] ^= (uint8_t)(1 + below(v, 255));
    if (f->airtime_ns) v->last_arrival[receiver] = e;
}

static void broadcast(live *v, int sender, const uint8_t *data, int length, int64_t later)
{
    for (int j = 0; j < v->hosts; j++) {
        if (j == sender || !v->host[j].on) continue;
        if (sender >= 0 && v->cut[j] >> sender & 1) continue;
        if (happens(v, v->loss)) continue;
        deliver(v, j, data, length, later);
        if (happens(v, v->duplicate)) deliver(v, j, data, length, later + below(v, SECOND / 10));
    }
}

static int is_active(const live *v, int kind, int agent)
{
    for (int i = 0; i < v->f->fault_count; i++)
        if (v->active >> i & 1 && v->f->faults[i].kind == kind && v->f->faults[i].agent == agent)
            return i + 1;
    return 0;
}

static void send(live *v, int i, const uint8_t *data, int length)
{
    host *h = &v->host[i];
    const int64_t slot = v->f->station.slot_ns;
    dtsa_station_status s;
    if (is_active(v, LIVE_REFUSE, i)) {
        dtsa_station_sent(h->station, clock_of(h, v->now), 0);
        tell(v,
             (live_call){.host = i, .kind = LIVE_SENT, .now_ns = clock_of(h, v->now), .answer = 0});
        return;
    }
    dtsa_station_sent(h->station, clock_of(h, v->now), 1);
    tell(v, (live_call){.host = i, .kind = LIVE_SENT, .now_ns = clock_of(h, v->now), .answer = 1});
    note_bytes(v, data, length);
    const uint64_t at = v->r->sent++ % HISTORY_LENGTH;
    memcpy(v->history[at].data, data, (size_t)length);
    v->history[at].length = length;
    dtsa_station_get_status(h->station, &s);
    h->sent_slot = s.slot;
    h->sent_at = v->now;
    const int turn = dtsa_agent_decision(h->agent).reason;
    for (int j = 0; j < v->n; j++) { /* another sender in step, in the same slot */
        const host *o = &v->host[j];
        if (j == i || !o->on || o->id == h->id || v->now - o->sent_at > slot * 3 / 2) continue;
        const int64_t apart = time_of(h, dtsa_station_slot_start(h->station, h->sent_slot)) -
                              time_of(o, dtsa_station_slot_start(o->station, o->sent_slot));
        if (apart > slot / 4 || apart < -slot / 4) continue;
        const int theirs = dtsa_agent_decision(o->agent).reason;
        v->r->shared++;
        const int may = turn == DTSA_REASON_LEASE_OPEN || turn == DTSA_REASON_LEASE_ADOPTED ||
                        theirs == DTSA_REASON_LEASE_OPEN || theirs == DTSA_REASON_LEASE_ADOPTED;
        if (v->f->config.policy == DTSA_POLICY_TDMA && o->sent_slot == h->sent_slot && !may)
            violate(v, LIVE_TWO_SENDERS, i, j);
    }
    const int delay = is_active(v, LIVE_DELAY, i);
    broadcast(v, i, data, length, delay ? (int64_t)v->f->faults[delay - 1].amount : 0);
}

/* ---- stations ---- */

static void sense(host *h) { dtsa_agent_set_state(h->agent, h->position, h->velocity); }

/* A flight's vehicle: it flies as it is commanded, at once. */
static void fly(live *v, host *h)
{
    const double t = (double)v->f->station.slot_ns * 1e-9;
    dtsa_station_status s;
    dtsa_station_get_status(h->station, &s);
    if (s.slot >= 0) dtsa_agent_command(h->agent, s.slot, 0, h->velocity);
    for (int i = 0; i < 3; i++) h->position[i] += h->velocity[i] * t;
    if (s.hovers == DTSA_FLIES)
        v->r->flown++;
    else
        v->r->hovered++;
}

/* Since it last could fly, an agent does not fly for longer than it takes to notice that it cannot. */
static void check_quorum(live *v, int i)
{
    host *h = &v->host[i];
    const int64_t limit = v->quorum_slack_ns, slot = v->f->station.slot_ns;
    const int64_t since = v->now - h->checked_at < slot ? v->now - h->checked_at : slot;
    dtsa_station_status s;
    int both = 0;
    h->checked_at = v->now;
    dtsa_station_get_status(h->station, &s);
    for (int j = 0; j < v->n; j++) {
        int is_heard =
            !v->f->station.link.names; /* by whoever has that id; unknown without names */
        for (int k = 0; k < v->hosts; k++)
            is_heard |= v->host[k].id == j + 1 && v->host[k].received[h->id - 1] >= v->now - limit;
        both += j != h->id - 1 && h->received[j] >= v->now - limit && is_heard;
    }
    if (both >= s.needed)
        h->wrong_ns = 0;
    else if (s.hovers == DTSA_FLIES && (h->wrong_ns += since) > limit)
        violate(v, LIVE_WITHOUT_QUORUM, i, both);
}

static void step(live *v, int i)
{
    host *h = &v->host[i];
    uint8_t datagram[DTSA_DATAGRAM_MAX];
    for (int k = 0; k < SPIN_LIMIT; k++) {
        int length = 0;
        dtsa_station_status before, after;
        const int64_t now = clock_of(h, v->now);
        dtsa_station_get_status(h->station, &before);
        sense(h);
        const int64_t due = dtsa_station_step(h->station, now, datagram, &length);
        v->r->steps++;
        dtsa_station_get_status(h->station, &after);
        tell(v, (live_call){.host = i,
                            .kind = LIVE_STEPPED,
                            .now_ns = now,
                            .answer = due,
                            .out = datagram,
                            .out_length = length,
                            .status = &after,
                            .position = {h->position[0], h->position[1], h->position[2]},
                            .velocity = {h->velocity[0], h->velocity[1], h->velocity[2]}});
        if (length) send(v, i, datagram, length);
        if (after.slots != before.slots || after.slot != before.slot) {
            fly(v, h);
            check_quorum(v, i);
        }
        if (due > now) {
            push(v, time_of(h, due) + below(v, v->f->wake_ns), WAKE, i, ++h->token);
            return;
        }
    }
    violate(v, LIVE_SPINS, i, 0);
}

static void note_reception(live *v, int i, const uint8_t *data)
{
    const uint8_t *frame = data + datagram_head(&v->f->station.link);
    const int id = v->f->station.extended ? frame[1] : frame[1] | frame[2] << 8;
    if (id >= 1 && id <= v->n) v->host[i].received[id - 1] = v->now;
}

static void receive(live *v, int i, const uint8_t *data, int length, int64_t at)
{
    host *h = &v->host[i];
    const int64_t arrival = clock_of(h, at);
    const dtsa_verdict verdict = dtsa_station_receive(h->station, data, length, arrival);
    if (verdict == DTSA_ACCEPTED) note_reception(v, i, data);
    tell(v, (live_call){.host = i,
                        .kind = LIVE_RECEIVED,
                        .now_ns = arrival,
                        .data = data,
                        .length = length,
                        .answer = verdict});
}

static void start(live *v, int i)
{
    const live_flight *f = v->f;
    host *h = &v->host[i];
    dtsa_station_settings s = f->station;
    const int64_t now = clock_of(h, v->now);
    s.id = h->id;
    h->agent = dtsa_agent_start(h->agent_memory, dtsa_agent_bytes(&f->config), &f->config, h->id);
    if (!h->agent) {
        v->failed = 1;
        return;
    }
    if (f->first_slot && !v->now) {
        s.begins = DTSA_BEGINS_TOGETHER;
        s.origin_ns = now + s.slot_ns - f->first_slot * s.slot_ns;
    }
    const dtsa_station_agent agent = dtsa_station_agent_of(h->agent);
    h->station = dtsa_station_start(h->memory, dtsa_station_bytes(&s), &s, &agent, now);
    if (!h->station) {
        v->failed = 1;
        return;
    }
    h->on = 1;
    h->queue_count = 0;
    h->sent_at = INT64_MIN / 2;
    tell(v, (live_call){.host = i, .kind = LIVE_STARTED, .now_ns = now, .answer = h->id});
    step(v, i);
}

static void stop(live *v, int i)
{
    v->host[i].on = 0;
    tell(v, (live_call){.host = i, .kind = LIVE_ENDED});
}

static void wake(live *v, int i)
{
    host *h = &v->host[i];
    for (int k = 0; k < h->queue_count; k++)
        receive(v, i, h->queue[k].data, h->queue[k].length, h->queue[k].at);
    h->queue_count = 0;
    step(v, i);
    dtsa_station_status s;
    dtsa_station_get_status(h->station, &s);
    if (s.gone) stop(v, i);
}

static void arrive(live *v, const event *e)
{
    host *h = &v->host[e->host];
    if (!e->length || !h->on) return;
    if (v->now < h->stalled_until) {
        if (h->queue_count == QUEUE_LENGTH) return;
        queued *q = &h->queue[h->queue_count++];
        q->at = v->now;
        q->length = e->length;
        memcpy(q->data, e->data, (size_t)e->length);
        return;
    }
    receive(v, e->host, e->data, e->length, v->now);
    step(v, e->host);
}

/* ---- faults ---- */

static void apply(live *v)
{
    memset(v->cut, 0, sizeof v->cut);
    v->jitter = 0;
    v->loss = v->duplicate = v->corrupt = 0.0;
    for (int k = 0; k < v->f->fault_count; k++) {
        const live_fault *a = &v->f->faults[k];
        if (!(v->active >> k & 1)) continue;
        if (a->kind == LIVE_LOSS && a->amount > v->loss) v->loss = a->amount;
        if (a->kind == LIVE_JITTER && (int64_t)a->amount > v->jitter)
            v->jitter = (int64_t)a->amount;
        if (a->kind == LIVE_DUPLICATE) v->duplicate = a->amount;
        if (a->kind == LIVE_CORRUPT) v->corrupt = a->amount;
        for (int i = 0; i < v->hosts; i++) {
            const uint64_t own = (uint64_t)1 << i;
            if (a->kind == LIVE_PARTITION) v->cut[i] |= a->group & own ? ~a->group : a->group;
            if (a->kind == LIVE_ONE_WAY && a->group & own) v->cut[i] |= (uint64_t)1 << a->agent;
            if (a->kind == LIVE_MUTE || a->kind == LIVE_SUSPEND)
                v->cut[i] |= (uint64_t)1 << a->agent;
            if ((a->kind == LIVE_DEAF || a->kind == LIVE_SUSPEND) && i == a->agent)
                v->cut[i] = ~(uint64_t)0;
        }
    }
}

static void inject(live *v, int k)
{
    const live_fault *a = &v->f->faults[k];
    uint8_t data[DTSA_DATAGRAM_MAX];
    int length = dtsa_datagram_length(&v->f->station);
    if (!v->r->sent || !(v->active >> k & 1)) return;
    if (a->kind == LIVE_REPLAY) {
        const uint64_t kept = v->r->sent < HISTORY_LENGTH ? v->r->sent : HISTORY_LENGTH;
        const int at = (int)below(v, (int64_t)kept);
        length = v->history[at].length;
        memcpy(data, v->history[at].data, (size_t)length);
    } else {
        memcpy(data, v->history[(v->r->sent - 1) % HISTORY_LENGTH].data, (size_t)length);
        uint8_t *frame = data + datagram_head(&v->f->station.link);
        frame[1] = (uint8_t)(1 + below(v, v->n));
        for (int i = 4; i < 8; i++) frame[i] = (uint8_t)draw(v);
    }
    broadcast(v, -1, data, length, 0);
    push(v, v->now + (int64_t)(1e9 / a->amount), INJECT, 0, k);
}

static void begin_fault(live *v, int k)
{
    const live_fault *a = &v->f->faults[k];
    host *h = &v->host[a->agent];
    v->active |= (uint64_t)1 << k;
    if (a->kind == LIVE_STALL || a->kind == LIVE_SUSPEND)
        if (v->now + a->lasts_ns > h->stalled_until) h->stalled_until = v->now + a->lasts_ns;
    if (a->kind == LIVE_STEP) step_clock(v, h, (int64_t)a->amount);
    if (a->kind == LIVE_CRASH && h->on) stop(v, a->agent);
    if (a->kind == LIVE_LEAVE && h->on) {
        dtsa_station_leave(h->station);
        tell(v, (live_call){.host = a->agent, .kind = LIVE_LEFT});
    }
    if (a->kind == LIVE_SAME_ID && a->agent < v->n) {
        host *twin = &v->host[v->n + k % (v->hosts - v->n)];
        if (!twin->on) {
            twin->id = h->id;
            memcpy(twin->position, h->position, sizeof h->position);
            start(v, (int)(twin - v->host));
        }
    }
    apply(v);
    if (a->kind == LIVE_REPLAY || a->kind == LIVE_FORGE) inject(v, k);
}

static void end_fault(live *v, int k)
{
    const live_fault *a = &v->f->faults[k];
    host *h = &v->host[a->agent];
    v->active &= ~((uint64_t)1 << k);
    if (a->kind == LIVE_SUSPEND) step_clock(v, h, -a->lasts_ns);
    if (a->kind == LIVE_SAME_ID) {
        const int twin = v->n + k % (v->hosts - v->n);
        if (v->host[twin].on) stop(v, twin);
    }
    if ((a->kind == LIVE_SUSPEND || a->kind == LIVE_STALL || a->kind == LIVE_STEP) && h->on)
        push(v, v->now + 1000, WAKE, a->agent, ++h->token);
    apply(v);
    if (a->kind == LIVE_LEAVE && h->on) stop(v, a->agent);
    if ((a->kind == LIVE_CRASH || a->kind == LIVE_LEAVE) && !h->on) start(v, a->agent);
}

static void change_goals(live *v)
{
    for (int i = 0; i < v->hosts; i++) {
        host *h = &v->host[i];
        if (!h->on || below(v, 2)) continue;
        const int there = (int)below(v, 2);
        const double *goal = there ? h->away : h->home;
        dtsa_agent_set_goal(h->agent, goal, 0);
        tell(v, (live_call){
                    .host = i, .kind = LIVE_NEW_GOAL, .position = {goal[0], goal[1], goal[2]}});
    }
    push(v, v->now + v->f->goal_every_ns, GOALS, 0, 0);
}

/* ---- a flight ---- */

static void run(live *v, int64_t until)
{
    while (v->count && v->heap[0]->at <= until && !v->failed && !v->r->violation) {
        event *e = pop(v);
        host *h = &v->host[e->host];
        v->now = e->at;
        if (e->kind == WAKE && h->on && e->index == h->token) {
            if (v->now < h->stalled_until)
                push(v, h->stalled_until + below(v, v->f->wake_ns), WAKE, e->host, h->token);
            else
                wake(v, e->host);
        }
        if (e->kind == ARRIVE) {
            if (v->last_arrival[e->host] == e) v->last_arrival[e->host] = NULL;
            arrive(v, e);
        }
        if (e->kind == START) start(v, e->host);
        if (e->kind == BEGIN) begin_fault(v, e->index);
        if (e->kind == END) end_fault(v, e->index);
        if (e->kind == INJECT) inject(v, e->index);
        if (e->kind == GOALS) change_goals(v);
        v->spare[v->spares++] = e;
    }
    if (!v->failed && !v->r->violation) v->now = until;
}

/* All in step, all hear all, all fly. */
static int is_together(live *v)
{
    int64_t least = INT64_MAX, most = INT64_MIN;
    const int64_t slot = v->f->station.slot_ns;
    for (int i = 0; i < v->n; i++) {
        host *h = &v->host[i];
        dtsa_station_status s;
        if (!h->on) return 0;
        dtsa_station_get_status(h->station, &s);
        if (s.state == DTSA_LISTENING || s.hovers != DTSA_FLIES || s.hears < v->n - 1) return 0;
        const int64_t cycle = (int64_t)v->f->station.slot_cycle;
        const int64_t canonical = s.slot - s.slot / cycle * cycle;
        const int64_t origin =
            time_of(h, dtsa_station_slot_start(h->station, s.slot)) - canonical * slot;
        if (origin < least) least = origin;
        if (origin > most) most = origin;
    }
    return most - least < v->f->station.link.trust_ns * 3 / 2;
}

static int open_hosts(live *v)
{
    const live_flight *f = v->f;
    v->host = calloc((size_t)v->hosts, sizeof *v->host);
    if (!v->host) return 0;
    for (int i = 0; i < v->hosts; i++) {
        host *h = &v->host[i];
        const live_host *given = &f->hosts[i];
        h->id = i < v->n ? i + 1 : 1;
        dtsa_station_settings s = f->station;
        s.id = h->id;
        h->memory = calloc(1, dtsa_station_bytes(&s) + 1);
        h->agent_memory = calloc(1, dtsa_agent_bytes(&f->config) + 1);
        h->queue = calloc(QUEUE_LENGTH, sizeof *h->queue);
        h->received = calloc((size_t)v->hosts, sizeof *h->received);
        if (!h->memory || !h->agent_memory || !h->queue || !h->received) return 0;
        h->clock_ref = given->clock_ns;
        h->drift = given->drift_ppb;
        for (int k = 0; k < v->hosts; k++) h->received[k] = INT64_MIN;
        for (int d = 0; d < 3; d++) {
            h->position[d] = h->home[d] = f->config.start[d * v->n + h->id - 1];
            h->away[d] = f->config.target[d * v->n + h->id - 1];
        }
        if (i < v->n) push(v, given->start_ns, START, i, 0);
    }
    return !v->failed;
}

static void close_hosts(live *v)
{
    for (int i = 0; v->host && i < v->hosts; i++) {
        host *h = &v->host[i];
        if (h->on) {
            dtsa_station_status s;
            dtsa_station_get_status(h->station, &s);
            v->r->restarts += s.restarts;
            v->r->shifts += s.shifts;
        }
        free(h->memory);
        free(h->agent_memory);
        free(h->queue);
        free(h->received);
    }
    free(v->host);
    for (int i = 0; i < v->count; i++) free(v->heap[i]);
    for (int i = 0; i < v->spares; i++) free(v->spare[i]);
    free(v->heap);
    free(v->spare);
}

int live_fly(const live_flight *f, live_result *r, live_observer observer, void *context)
{
    live v = {.f = f, .r = r, .observer = observer, .context = context, .n = f->config.agents};
    const int64_t part = f->bound_ns / 64 + 1;
    *r = (live_result){.together_ns = -1, .hash = HASH_START};
    v.hosts = v.n + 2;
    if (v.hosts > LIVE_HOSTS_MAX) return 0;
    v.random = f->seed;
    const dtsa_station_settings *c = &f->station; /* silence, and then all have to say so */
    const int names = c->link.names, lists = names > 1 ? (v.n - 1) / (names - 1) + 2 : 8 * v.n;
    v.quorum_slack_ns = (6 + 2 * lists) * (int64_t)c->main_every * v.n * c->slot_ns;
    if (open_hosts(&v)) {
        for (int k = 0; k < f->fault_count; k++) {
            push(&v, f->faults[k].at_ns, BEGIN, 0, k);
            push(&v, f->faults[k].at_ns + f->faults[k].lasts_ns, END, 0, k);
        }
        if (f->goal_every_ns) push(&v, f->goal_every_ns, GOALS, 0, 0);
        run(&v, f->heal_ns);
        for (int64_t t = f->heal_ns; t < f->heal_ns + f->bound_ns && r->together_ns < 0;
             t += part) {
            run(&v, t + part);
            if (v.failed || r->violation) break;
            if (is_together(&v)) r->together_ns = v.now - f->heal_ns;
        }
        if (!r->violation && r->together_ns < 0) violate(&v, LIVE_NOT_TOGETHER, 0, 0);
        r->agent_s = (double)v.n * (double)v.now * 1e-9;
    }
    close_hosts(&v);
    return !v.failed;
}
