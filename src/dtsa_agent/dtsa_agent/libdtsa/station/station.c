/* The loop of one station. It listens first; it takes the slot times of the first frame that arrives,
 * or begins by its own clock. Then it opens slot after slot, and sends in the turns of its agent. */
#include <string.h>

#include "core.h"
#include "policy/policy.h"
#include "station.h"

/* In thousandths of a slot: an agent decides LEAD before the slot starts; if it still waits for the
 * present slot's frame, LATEST_LEAD before. */
enum { LEAD = 700, LATEST_LEAD = 200 };
static const int64_t HALF_SECOND_NS = 500000000;

static int64_t slot_share(int64_t slot_ns, int thousandths) { return slot_ns * thousandths / 1000; }

/* ---- set-up ---- */

static int is_usable(const dtsa_station_settings *c)
{
    const dtsa_link *link = &c->link;
    return c->agents >= 1 && c->agents <= DTSA_AGENTS_MAX && c->id >= 1 && c->id <= c->agents &&
           c->anchor_every >= 1 && c->main_every >= c->anchor_every && c->slot_ns >= 1 &&
           c->slot_cycle >= 1 && c->frame_length >= 8 && c->own_bytes >= 0 && c->early_count >= 1 &&
           link->names >= 0 && link->names <= DTSA_NAMES_MAX && link->header_length >= 0 &&
           link->header_length <= DTSA_HEADER_MAX && link->trust_ns >= 1 &&
           (!c->key || (c->key_length >= 16 && c->key_length <= 32)) &&
           datagram_head(link) + c->frame_length + DTSA_TAG_BYTES <= DTSA_DATAGRAM_MAX;
}

static size_t aligned(size_t bytes) { return (bytes + 7) / 8 * 8; }

size_t dtsa_station_bytes(const dtsa_station_settings *c)
{
    if (!is_usable(c)) return 0;
    const size_t n = (size_t)c->agents, early = (size_t)c->early_count;
    return aligned(sizeof(dtsa_station)) + n * sizeof(peer) + n * sizeof(int64_t) +
           early * sizeof(early_frame) + aligned(DTSA_DATAGRAM_MAX) +
           aligned(early * (size_t)dtsa_datagram_length(c));
}

/* Places the arrays in the memory behind the station. */
static void place_arrays(dtsa_station *s, uint8_t *at)
{
    const size_t n = (size_t)s->settings.agents, early = (size_t)s->settings.early_count;
    s->peers = (peer *)at;
    at += n * sizeof(peer);
    s->sums = (int64_t *)at;
    at += n * sizeof(int64_t);
    s->early = (early_frame *)at;
    at += early * sizeof(early_frame);
    s->frame = at;
    at += aligned(DTSA_DATAGRAM_MAX);
    for (size_t i = 0; i < early; i++) s->early[i].datagram = at + i * (size_t)s->datagram_length;
    for (size_t k = 0; k < n; k++)
        s->peers[k] = (peer){.heard_ns = INT64_MIN, .near_ns = INT64_MIN, .last_slot = -1};
}

int64_t dtsa_station_too_long(const dtsa_station_settings *c)
{
    const int64_t rounds = (int64_t)c->anchor_every * c->agents;
    return c->equal_tables ? INT64_MAX : larger(500, 3 * rounds) * c->slot_ns;
}

static void set_times(dtsa_station *s)
{
    const dtsa_station_settings *c = &s->settings;
    const int64_t slot = c->slot_ns, anchors = (int64_t)c->anchor_every * c->agents * slot,
                  mains = (int64_t)c->main_every * c->agents * slot;
    s->round_ns = anchors;
    s->moving_ns = larger((c->sends == DTSA_SENDS_BY_CHANCE ? 18 : 2) * anchors, HALF_SECOND_NS);
    s->resting_ns = c->sends == DTSA_SENDS_IN_ANCHORS ? larger(6 * mains, HALF_SECOND_NS)
                    : c->sends == DTSA_SENDS_IN_TURNS ? s->moving_ns
                                                      : INT64_MAX;
    s->patience_ns = larger(2 * mains, HALF_SECOND_NS);
    s->lead_ns = slot_share(slot, LEAD);
    s->latest_lead_ns = c->equal_tables
                            ? -smaller(slot_share(slot, DTSA_MAX_WAIT), DTSA_MAX_WAIT_NS)
                            : slot_share(slot, LATEST_LEAD);
    s->latest_send_ns =
        larger(slot - c->link.flight_ns - slot_share(slot, DTSA_BETWEEN), slot / 10);
    s->too_long_ns = dtsa_station_too_long(c);
}

/* A pseudo-random number, by seed, id and index. */
static uint64_t draw(const dtsa_station *s, uint64_t index)
{
    return mix64(s->settings.seed * 0x9e3779b97f4a7c15ULL +
                 (uint64_t)s->settings.id * 0xd1b54a32d192ed03ULL + index * 0x8cb92ba72f3d8dd7ULL -
                 0x9e3779b97f4a7c15ULL);
}

static void restart(dtsa_station *s, int64_t now);

dtsa_station *dtsa_station_start(void *memory, size_t bytes, const dtsa_station_settings *settings,
                                 const dtsa_station_agent *agent, int64_t now)
{
    const size_t needed = dtsa_station_bytes(settings);
    if (!memory || !needed || bytes < needed || (uintptr_t)memory % sizeof(double)) return NULL;
    dtsa_station *s = memory;
    memset(memory, 0, needed);
    s->settings = *settings;
    s->agent = *agent;
    s->datagram_length = dtsa_datagram_length(settings);
    s->head_length = datagram_head(&settings->link);
    place_arrays(s, (uint8_t *)memory + aligned(sizeof *s));
    set_times(s);
    s->slot = s->first = -1;
    s->same_id_until = s->refused_since = s->earlier_ns = INT64_MIN;
    s->hovers = DTSA_HOVERS_LISTENING;
    s->heard_ns = now;
    if (settings->begins == DTSA_BEGINS_TOGETHER) {
        s->state = DTSA_JOINED;
        s->origin_ns = settings->origin_ns;
        s->in_step_ns = now;
        s->first = 0;
    } else {
        /* The ends of listening are spread over a round of anchors: one agent begins first, and the
         * others receive its frames while they still listen. */
        s->state = DTSA_LISTENING;
        s->deadline_ns = now + s->round_ns + (int64_t)(draw(s, 0) % (uint64_t)s->round_ns);
    }
    return s;
}

void dtsa_station_observe(dtsa_station *s, const dtsa_station_events *events)
{
    s->events = *events;
}

/* ---- slots ---- */

int64_t dtsa_station_slot_start(const dtsa_station *s, int64_t slot)
{
    return s->origin_ns + slot * s->settings.slot_ns;
}

static void close_slot(dtsa_station *s)
{
    if (!s->running) return;
    if (s->frame_length) { /* a restart before the frame was sent */
        s->agent.unsent(s->agent.context);
        s->frame_length = 0;
    }
    s->agent.close(s->agent.context, s->slot);
    s->counts.slots++;
    s->running = 0;
}

/* The agent forgets all frames, and takes part from the next slot on. */
static void restart(dtsa_station *s, int64_t now)
{
    close_slot(s);
    s->slot = clock_slot(s, now + s->lead_ns);
    s->first = s->slot + 1;
    s->awaits = s->has_sent = s->early_count = 0;
    s->newcomer = 1;
    s->hovers = DTSA_HOVERS_NEW;
    delay_reset(s);
    for (int k = 0; k < s->settings.agents; k++) {
        s->peers[k].hears_us = 0;
        s->peers[k].was_heard = 0;
    }
    s->agent.restart(s->agent.context);
    if (s->events.restarted) s->events.restarted(s->events.context, s->slot);
    s->counts.restarts++;
}

/* Updates the longest gap with the slots since agent k's last frame, unless this agent is new. */
static void update_longest_gap(dtsa_station *s, int k, int64_t slot)
{
    const peer *p = &s->peers[k];
    const int32_t gap = (int32_t)((uint32_t)slot - p->heard_slot);
    if (s->newcomer || !p->was_heard || gap <= s->longest_gap) return;
    s->longest_gap = gap;
    s->longest_of = k + 1;
}

static void receive_frame(dtsa_station *s, int sender, int64_t slot, const uint8_t *datagram,
                          int64_t arrival)
{
    const int accepted =
        s->agent.hear(s->agent.context, slot, datagram + s->head_length, s->settings.frame_length);
    if (accepted) {
        s->counts.heard++;
        update_longest_gap(s, sender - 1, slot);
        s->peers[sender - 1].heard_slot = (uint32_t)slot;
        s->peers[sender - 1].was_heard = !s->peers[sender - 1].left;
    }
    if (s->awaits && slot >= s->slot) s->awaits = 0;
    if (s->events.heard)
        s->events.heard(s->events.context, sender, slot, datagram, s->datagram_length, arrival,
                        accepted);
}

/* Whether the agent is new: the others do not know it yet, or it does not know them. */
static int is_new(dtsa_station *s, int64_t slot, int64_t now)
{
    if (s->newcomer && s->has_sent && slot >= s->first + s->settings.agents &&
        now >= s->same_id_until && !s->agent.on_probation(s->agent.context))
        s->newcomer = 0;
    return s->newcomer;
}

static int find_hover_reason(dtsa_station *s, int64_t slot, int64_t now)
{
    const int quorum = contacts_have_quorum(s, now);
    const int newcomer = is_new(s, slot, now);
    if (now < s->same_id_until) return DTSA_HOVERS_SAME_ID;
    if (newcomer) return DTSA_HOVERS_NEW;
    return quorum ? DTSA_FLIES : DTSA_HOVERS_QUORUM;
}

/* Receives the stored frames whose slot has begun. */
static void receive_early_frames(dtsa_station *s)
{
    int kept = 0;
    for (int i = 0; i < s->early_count; i++) {
        const early_frame e = s->early[i];
        if (e.slot > s->slot) {
            s->early[i] = s->early[kept];
            s->early[kept++] = e;
        } else {
            receive_frame(s, e.sender, e.slot, e.datagram, e.arrival_ns);
        }
    }
    s->early_count = kept;
}

/* Whether the agent does not send its frame. A new agent is silent while another one sends with its id:
 * the other was here first. One that has received no frame for long sends half of its frames, at random:
 * the others may collide with frames of agents whose slots begin at other times. */
static int withholds_frame(const dtsa_station *s, int64_t slot, int64_t now)
{
    return (s->newcomer && now < s->same_id_until) ||
           (now - s->heard_ns > s->patience_ns && !s->settings.keeps_time &&
            draw(s, (uint64_t)slot) & 1);
}

static void open_slot(dtsa_station *s, int64_t slot, int64_t now)
{
    int chosen = 0;
    close_slot(s);
    s->hovers = find_hover_reason(s, slot, now);
    s->slot = slot;
    if (s->leaving && !s->gone) s->agent.leave(s->agent.context); /* its last frame was not sent */
    s->frame_length =
        s->agent.open(s->agent.context, slot, s->hovers != DTSA_FLIES, s->frame, &chosen);
    s->running = 1;
    s->awaits = chosen && chosen != s->settings.id;
    if (s->events.opened)
        s->events.opened(s->events.context, slot, dtsa_station_slot_start(s, slot), now,
                         slot == s->first);
    if (s->frame_length && withholds_frame(s, slot, now)) {
        s->agent.unsent(s->agent.context);
        s->frame_length = 0;
    }
    receive_early_frames(s);
}

/* ---- the own frame ---- */

/* Writes the datagram of the ready frame; too late in the slot, it would disturb the next turn and is
 * dropped. -> its length, 0: none. */
static int send_frame(dtsa_station *s, int64_t now, uint8_t *datagram)
{
    const int64_t late = now - dtsa_station_slot_start(s, s->slot);
    if (late > s->latest_send_ns) {
        s->agent.unsent(s->agent.context);
        s->frame_length = 0;
        s->counts.unsent++;
        return 0;
    }
    dtsa_named names[DTSA_NAMES_MAX] = {{0, 0}};
    delay_name(s, now, names);
    dtsa_datagram_write(&s->settings, s->frame,
                        (uint32_t)((uint64_t)s->slot % s->settings.slot_cycle), late, names,
                        datagram);
    s->frame_length = 0;
    s->sent_hashes[s->sent_index++ % SENT_HISTORY_LENGTH] =
        datagram_hash(HASH_START, datagram, s->datagram_length);
    s->counts.sent++;
    s->has_sent = 1;
    if (s->leaving && frame_condition_of(s->frame).leaves) s->gone = 1;
    if (s->events.sent)
        s->events.sent(s->events.context, s->slot, datagram, s->datagram_length, now);
    return s->datagram_length;
}

void dtsa_station_sent(dtsa_station *s, int64_t now, int accepted)
{
    if (accepted) {
        s->refused_since = INT64_MIN;
        return;
    }
    if (s->refused_since == INT64_MIN) s->refused_since = now;
    s->agent.unsent(s->agent.context);
    s->counts.sent--;
    s->counts.unsent++;
}

void dtsa_station_leave(dtsa_station *s)
{
    s->leaving = 1;
    if (!s->agent.leave(s->agent.context)) s->gone = 1;
}

/* ---- what arrives ---- */

static dtsa_verdict refuse(dtsa_station *s, dtsa_verdict verdict, const uint8_t *data, long length,
                           int64_t arrival)
{
    s->counts.refused[verdict]++;
    if (s->events.refused) s->events.refused(s->events.context, verdict, data, length, arrival);
    return verdict;
}

/* A datagram with the own id is an echo or a replay of an own one, or comes from another agent with
 * that id. apart: from the own slot times, ns. */
static dtsa_verdict classify_own_id(dtsa_station *s, const uint8_t *data, long length,
                                    int64_t arrival, int64_t apart)
{
    const uint64_t hash = datagram_hash(HASH_START, data, length);
    for (int i = 0; i < SENT_HISTORY_LENGTH; i++)
        if (s->sent_hashes[i] == hash) return DTSA_REPEATED;
    if (apart >= s->settings.slot_ns / 2 || apart <= -s->settings.slot_ns / 2)
        return DTSA_OTHER_TIME;
    s->same_id_until = arrival + s->patience_ns;
    return DTSA_SAME_ID;
}

/* Stores a frame of a slot that has not begun. */
static void store_early_frame(dtsa_station *s, int sender, int64_t slot, const uint8_t *data,
                              int64_t arrival)
{
    if (s->early_count == s->settings.early_count) {
        refuse(s, DTSA_TOO_EARLY, data, s->datagram_length, arrival);
        return;
    }
    early_frame *e = &s->early[s->early_count++];
    e->slot = slot;
    e->sender = sender;
    e->arrival_ns = arrival;
    memcpy(e->datagram, data, (size_t)s->datagram_length);
}

/* Counts a frame that is near the own slot times, and whether it is off by more than a quarter slot. */
static void count_offset(dtsa_station *s, int64_t off)
{
    enum { NEAR_SLOTS = 8 };
    if (off < 0) off = -off;
    if (s->state == DTSA_LISTENING || off > NEAR_SLOTS * s->settings.slot_ns) return;
    s->counts.timed++;
    s->counts.off += off > s->settings.slot_ns / 4;
}

dtsa_verdict dtsa_station_receive(dtsa_station *s, const uint8_t *data, long length,
                                  int64_t arrival)
{
    const dtsa_station_settings *c = &s->settings;
    dtsa_datagram d;
    dtsa_verdict verdict = dtsa_datagram_read(c, data, length, &d);
    if (verdict) return refuse(s, verdict, data, length, arrival);
    const int listens = s->state == DTSA_LISTENING;
    const int64_t began = arrival - c->link.flight_ns - d.late_ns,
                  start = began - s->flight_error_ns;
    int64_t slot = listens ? (int64_t)d.slot : clock_unwrap(s, d.slot, start);
    const int64_t expected = dtsa_station_slot_start(s, slot);
    peer *p = &s->peers[d.sender - 1];
    if (d.sender == c->id) {
        verdict =
            listens ? DTSA_OTHER_TIME : classify_own_id(s, data, length, arrival, start - expected);
        return refuse(s, verdict, data, length, arrival);
    }
    if (p->last_slot == d.slot && !listens) return refuse(s, DTSA_REPEATED, data, length, arrival);
    p->last_slot = d.slot;
    s->heard_ns = arrival;
    count_offset(s, start - expected);
    const int outcome = clock_hear(s, d.sender - 1, start - slot * c->slot_ns, arrival);
    if (outcome == OTHER) return refuse(s, DTSA_OTHER_TIME, data, length, arrival);
    if (outcome == RESTARTED) {
        slot = (int64_t)d.slot;
        s->origin_ns = start - slot * c->slot_ns;
        restart(s, arrival);
    } else {
        s->counts.shifts += outcome == SHIFTED;
        delay_hear(s, &d, began - expected, arrival);
        delay_shift(s, dtsa_station_slot_start(s, slot) - expected);
    }
    contacts_hear(s, &d);
    if (slot > s->slot)
        store_early_frame(s, d.sender, slot, data, arrival);
    else if (slot >= s->first - 1)
        receive_frame(s, d.sender, slot, data, arrival);
    return DTSA_ACCEPTED;
}

/* ---- what is due ---- */

/* When the next step is due; in the past: at once. An agent that waits for a frame is due when it could
 * decide, and again when it has to. */
static int64_t due_ns(const dtsa_station *s, int64_t now)
{
    if (s->state == DTSA_LISTENING) return s->deadline_ns;
    if (s->frame_length) return dtsa_station_slot_start(s, s->slot);
    const int64_t next = dtsa_station_slot_start(s, s->slot + 1);
    return next - (s->awaits && now >= next - s->lead_ns ? s->latest_lead_ns : s->lead_ns);
}

int64_t dtsa_station_step(dtsa_station *s, int64_t now, uint8_t *datagram, int *length)
{
    *length = 0;
    const int64_t due = due_ns(s, now);
    if (now < due) return due;
    if (s->state == DTSA_LISTENING) {
        /* Not in slot 0: there agents begin together, if the settings say so. */
        s->origin_ns = s->settings.begins ? s->settings.origin_ns : now - s->round_ns;
        s->state = DTSA_ALONE;
        s->in_step_ns = now;
        restart(s, now);
    } else if (s->frame_length) {
        *length = send_frame(s, now, datagram);
    } else if (now - dtsa_station_slot_start(s, s->slot + 1) > s->too_long_ns) {
        restart(s, now);
    } else {
        open_slot(s, s->slot + 1, now);
    }
    return due_ns(s, now);
}

int dtsa_station_hovers(const dtsa_station *s) { return s->hovers; }

int64_t dtsa_station_slot(const dtsa_station *s) { return s->slot; }

int dtsa_station_awaits_frame(const dtsa_station *s, int64_t now)
{
    const int64_t next = dtsa_station_slot_start(s, s->slot + 1);
    return s->state == DTSA_LISTENING ||
           (s->awaits && !s->frame_length && now >= next - s->lead_ns);
}

int64_t dtsa_station_longest_gap(dtsa_station *s, int *agent)
{
    for (int k = 0; k < s->settings.agents; k++) update_longest_gap(s, k, s->slot);
    *agent = s->longest_of;
    return s->longest_gap;
}

void dtsa_station_get_status(const dtsa_station *s, dtsa_station_status *status)
{
    *status = s->counts;
    status->state = s->state;
    status->hovers = s->hovers;
    status->slot = s->slot;
    status->first = s->first;
    status->gone = s->gone;
    status->flight_error_ns = s->flight_error_ns;
    status->in_step = s->state == DTSA_LISTENING
                          ? 0
                          : clock_in_step(s, s->origin_ns + s->slot * s->settings.slot_ns);
}

/* ---- the station of an agent of libdtsa ---- */

static int agent_open(void *context, int64_t slot, int hovers, uint8_t frame[DTSA_DATAGRAM_MAX],
                      int *chosen)
{
    dtsa_agent_hover(context, hovers);
    const int length = dtsa_agent_slot(context, slot, frame);
    *chosen = dtsa_agent_decision(context).chosen;
    return length;
}

static int agent_hear(void *context, int64_t slot, const uint8_t *frame, long length)
{
    return dtsa_agent_hear(context, slot, frame, length);
}

static void agent_unsent(void *context) { dtsa_agent_unsent(context); }
static void agent_close(void *context, int64_t slot) { dtsa_agent_end(context, slot); }
static void agent_restart(void *context) { dtsa_agent_restart(context); }
static int agent_leave(void *context)
{
    dtsa_agent *a = context;
    if (a->policy->says_leaving) return a->present = PRESENT_LEAVING, 1;
    dtsa_agent_leave(a);
    return 0;
}

static int on_probation(void *context) { return dtsa_agent_status(context).probation; }

dtsa_station_agent dtsa_station_agent_of(dtsa_agent *agent)
{
    return (dtsa_station_agent){agent,       agent_open,    agent_hear,  agent_unsent,
                                agent_close, agent_restart, agent_leave, on_probation};
}
