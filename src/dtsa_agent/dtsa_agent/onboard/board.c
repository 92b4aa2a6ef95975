/* The loop of one agent on a microcontroller. */
#include "board.h"

#include <string.h>

#include "core.h"

/* Of a slot, in thousandths: as core/agents/pacing.py says. */
enum { LEAD = 700, LATEST_LEAD = 200, BETWEEN = 200 };

static int64_t share(int64_t slot_ns, int thousandths) { return slot_ns * thousandths / 1000; }

static int64_t most(int64_t a, int64_t b) { return a > b ? a : b; }

/* What comes before all begin together is of no bag: its slots are counted otherwise. */
static int is_watched(const board *b) { return b->watch && b->policy < 0; }

static dtsa_timebase *base_of(board *b) { return &b->hearing.base; }

/* Rounds between two main anchors. */
static int main_every(const dtsa_config *c)
{
    return c->lease.main_every ? c->lease.main_every : c->lease.anchor_every;
}

const char *board_start(board *b, const board_settings *s, int64_t now)
{
    const int n = b->config.agents, sealed = s->key != NULL;
    const dtsa_config config = b->config;
    const board_watch *watch = b->watch;
    static const int LENGTHS[DTSA_PROFILE_COUNT] = {19, 23, EXTENDED_LENGTH};
    memset(b, 0, sizeof *b);
    b->config = config;
    b->watch = watch;
    b->settings = *s;
    if (n < 1 || n > BOARD_AGENTS) return "agents";
    if (s->id < 1 || s->id > n) return "id";
    if (s->slot_ns < 1000000) return "slot";
    const char *fault = dtsa_config_fault(&b->config);
    if (fault) return fault;
    b->policy = -1;
    if (s->begin > 0) {
        b->policy = b->config.policy;
        b->config.policy = DTSA_POLICY_TDMA; /* of the same profile */
    }
    b->agent = dtsa_agent_start(b->memory, sizeof b->memory, &b->config, s->id);
    if (!b->agent) return "memory";
    hearing *h = &b->hearing;
    h->agents = n;
    h->self = s->id - 1;
    h->agreed = sealed ? 0 : (int)sizeof s->header;
    h->late_bytes = sealed ? 0 : 2;
    h->head = h->agreed + h->late_bytes;
    memcpy(h->header, s->header, sizeof s->header);
    if (s->key_length < 0 || s->key_length > (int)sizeof h->key) return "key";
    if (sealed) memcpy(h->key, s->key, (size_t)s->key_length);
    h->key_length = sealed ? s->key_length : 0;
    h->session = s->session;
    h->flight = s->flight_ns;
    h->position_step = b->config.position_step;
    h->length = h->head + LENGTHS[b->config.profile] + (sealed ? DTSA_TAG_BYTES : 0);
    if (h->length > BOARD_DATAGRAM) return "profile";
    h->delay.limit = s->slot_ns / 4;
    h->clock = (own_clock){now, 0, 0};
    if (!dtsa_timebase_init(&h->base, n, b->config.lease.anchor_every, s->slot_ns, s->id, s->seed))
        return "anchor_every";
    h->slot_ns = s->slot_ns;
    h->contact.resting = h->contact.named = (int64_t)6 * main_every(&b->config) * n;
    h->contact.moving = h->contact.resting;
    hearing_lay(h, b->delays, b->contacts);
    b->lead_ns = share(s->slot_ns, LEAD);
    b->latest_lead_ns = share(s->slot_ns, LATEST_LEAD);
    b->latest_send_ns =
        most(s->slot_ns - s->flight_ns - share(s->slot_ns, BETWEEN), s->slot_ns / 10);
    b->too_long_ns = most(500, (int64_t)3 * b->config.lease.anchor_every * n) * s->slot_ns;
    b->slot = b->first = -1;
    for (int k = 0; k < BOARD_AGENTS; k++) b->heard_ns[k] = INT64_MIN;
    dtsa_timebase_start(&h->base, now);
    return NULL;
}

/* ---- slots ---- */

static void close_slot(board *b)
{
    if (!b->running) return;
    if (b->waiting) { /* it begins anew before its turn has come */
        dtsa_agent_unsent(b->agent);
        b->waiting = 0;
    }
    dtsa_agent_end(b->agent, b->slot);
    b->counts.slots++;
    b->running = 0;
}

/* From the next slot on it takes part, knowing nothing. */
static void begin_anew(board *b, int64_t now)
{
    close_slot(b);
    b->slot = dtsa_timebase_slot(base_of(b), now + b->lead_ns);
    b->first = b->slot + 1;
    b->awaits = b->spoke = b->early_count = 0;
    b->newcomer = 1;
    dtsa_agent_restart(b->agent);
    if (is_watched(b)) b->watch->anew(b);
    b->counts.restarts++;
}

static void hear_frame(board *b, int sender, int64_t slot, const uint8_t *datagram, int length,
                       int64_t arrival)
{
    const int head = b->hearing.head, tag = b->hearing.key_length ? DTSA_TAG_BYTES : 0;
    const int accepted = dtsa_agent_hear(b->agent, slot, datagram + head, length - head - tag);
    b->counts.heard += (uint32_t)accepted;
    if (b->awaits && slot >= b->slot) b->awaits = 0;
    if (is_watched(b)) b->watch->heard(b, sender, slot, datagram, length, arrival, accepted);
}

verdict board_hear(board *b, const uint8_t *data, long length, int64_t arrival)
{
    said s;
    int restarted;
    const verdict v = hearing_take(&b->hearing, data, length, arrival, &s, &restarted);
    if (v != TAKEN) {
        b->counts.refused[v]++;
        return v;
    }
    if (restarted || b->first < 0) begin_anew(b, arrival);
    b->heard_ns[s.sender - 1] = arrival;
    if (s.slot > b->slot) {
        if (b->early_count == BOARD_EARLY) {
            b->counts.early++;
            return v;
        }
        b->early[b->early_count].slot = s.slot;
        b->early[b->early_count].sender = s.sender;
        b->early[b->early_count].arrival = arrival;
        b->early[b->early_count].length = (int)length;
        memcpy(b->early[b->early_count++].datagram, data, (size_t)length);
    } else if (s.slot >= b->first - 1) {
        hear_frame(b, s.sender, s.slot, data, (int)length, arrival);
    }
    return v;
}

/* Whether it still hovers because nobody knows it: see Newcomers in core/agents/joining.py. */
static int is_new(board *b, int64_t slot)
{
    if (b->newcomer && b->spoke && slot >= b->first + b->config.agents &&
        (b->config.policy != DTSA_POLICY_LEASE || !dtsa_agent_status(b->agent).probation))
        b->newcomer = 0;
    return b->newcomer;
}

static void open_slot(board *b, int64_t slot, int64_t now, const double position[3],
                      const double velocity[3])
{
    close_slot(b);
    dtsa_agent_set_state(b->agent, position, velocity);
    dtsa_agent_hover(b->agent, is_new(b, slot));
    memcpy(b->command, b->agent->command, sizeof b->command);
    b->waiting = dtsa_agent_slot(b->agent, slot, b->frame);
    b->slot = slot;
    b->running = 1;
    b->anew = slot == b->first;
    if (is_watched(b)) b->watch->opened(b, now);
    const int chosen = dtsa_agent_decision(b->agent).chosen;
    b->awaits = chosen && chosen != b->settings.id;
    int kept = 0;
    for (int i = 0; i < b->early_count; i++) {
        if (b->early[i].slot > slot)
            b->early[kept++] = b->early[i];
        else
            hear_frame(b, b->early[i].sender, b->early[i].slot, b->early[i].datagram,
                       b->early[i].length, b->early[i].arrival);
    }
    b->early_count = kept;
}

/* The frame that lies ready, unless its slot is as good as over. */
static int send(board *b, int64_t now, uint8_t *datagram)
{
    const int64_t late = now - dtsa_timebase_slot_start(base_of(b), b->slot);
    b->waiting = 0;
    if (late > b->latest_send_ns) { /* it would disturb whoever has the next turn */
        dtsa_agent_unsent(b->agent);
        b->counts.unsent++;
        return 0;
    }
    hearing_wrap(&b->hearing, b->frame, b->slot, late, datagram);
    b->counts.sent++;
    b->spoke = 1;
    if (is_watched(b)) b->watch->sent(b, datagram, (int)b->hearing.length, now);
    return (int)b->hearing.length;
}

/* All have a common time: from the next slot on, which is slot 0, they fly by the policy that nobody
 * can join. Who comes later stays out: its slots are of another time. */
static int64_t begin_together(board *b, int64_t now)
{
    close_slot(b);
    b->config.policy = b->policy;
    b->policy = -1;
    b->agent = dtsa_agent_start(b->memory, sizeof b->memory, &b->config, b->settings.id);
    base_of(b)->origin_ns += b->settings.begin * b->settings.slot_ns;
    for (int k = 0; k < b->config.agents; k++) b->hearing.last[k] = -1;
    contacts_clear(&b->hearing.contact);
    b->slot = -1;
    b->first = 0;
    b->awaits = b->early_count = 0;
    if (is_watched(b)) b->watch->anew(b);
    return now;
}

int64_t board_step(board *b, int64_t now, const double position[3], const double velocity[3],
                   uint8_t datagram[BOARD_DATAGRAM], int *length)
{
    dtsa_timebase *base = base_of(b);
    *length = 0;
    if (base->state == DTSA_LISTENING) {
        if (!dtsa_timebase_wake(base, now)) return base->deadline_ns;
        begin_anew(b, now);
    }
    if (b->waiting) {
        const int64_t start = dtsa_timebase_slot_start(base, b->slot);
        if (now < start) return start;
        *length = send(b, now, datagram);
        return now;
    }
    const int64_t next = dtsa_timebase_slot_start(base, b->slot + 1);
    if (b->policy >= 0 && b->slot + 1 == b->settings.begin) { /* the last frame before has come */
        return now < next - b->latest_lead_ns ? next - b->latest_lead_ns : begin_together(b, now);
    }
    const int64_t due = next - (b->awaits ? b->latest_lead_ns : b->lead_ns);
    if (now < due) return due;
    if (now - next > b->too_long_ns)
        begin_anew(b, now);
    else
        open_slot(b, b->slot + 1, now, position, velocity);
    return now;
}

int board_command(board *b, int64_t now, double command[3])
{
    const int steps = b->config.steps;
    if (!b->running || b->newcomer) {
        for (int i = 0; i < 3; i++) command[i] = 0.0;
        return 0;
    }
    const int64_t since = now - dtsa_timebase_slot_start(base_of(b), b->slot);
    const int64_t step = since < 0 ? 0 : since * steps / b->settings.slot_ns;
    dtsa_agent_command(b->agent, b->slot, (int)(step < steps ? step : steps - 1), command);
    return 1;
}

int board_stay(board *b, int64_t now, const double place[3], double command[3])
{
    double *goal = b->agent->goal, there[3];
    memcpy(there, goal, sizeof there);
    memcpy(goal, place, sizeof there);
    const int flies = board_command(b, now, command);
    memcpy(goal, there, sizeof there);
    return flies;
}

int board_rests(const board *b, int index) { return !b->agent->table->in_ap[index]; }

double board_place(const board *b, int index, int direction)
{
    return b->agent->table->sent_p[direction * b->config.agents + index];
}

int64_t board_age(const board *b, int index)
{
    const int64_t sent = b->agent->table->sent_slot[index];
    return sent < 0 ? -1 : b->slot - sent;
}
