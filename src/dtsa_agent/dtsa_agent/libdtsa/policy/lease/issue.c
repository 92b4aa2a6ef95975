/* Policy lease, the leases in a frame: turns that its sender gives away or hands on, and known
 * leases that it relays. The same in plain Python: core/reference/lease_issue.py. */
#include <math.h>
#include <string.h>

#include "lease.h"

static const double NEED = 50.0, MAX_NEED = 6000.0; /* NEED: s/m */

/* A moving agent hands on turns that are worth this many times as much to another agent. */
enum { HAND_ON_FACTOR = 2 };

/* Agents that may be given turns, and a forecast of which agent sends when. */
typedef struct {
    int alive;      /* N_alive: this agent and the agents heard of lately */
    int members;    /* N_p: agents in A_p that do not miss their turns */
    int block;      /* one turn in so many is OPEN, 0: none */
    int informed;   /* all agents have sent, or all goals are known to all */
    int64_t *last;  /* (n) last slot in which each agent sent, or is predicted to send */
    int64_t *next;  /* (n) next slot in which each agent is predicted to send */
    uint16_t *gap;  /* (w) slots from each turn to the next one of the same agent */
    int32_t *need;  /* (n) weight of each agent: grows with the last change of its velocity */
    uint8_t *able;  /* (n) may be given a turn */
    uint8_t *rests; /* (n) gives its turns away, as far as is known */
    uint8_t *final; /* (n) rests at its final goal: gives anchors away, too, except main ones */
    uint8_t *list;  /* (members) agents that are able */
} lease_candidates;

/* -> B: one turn in B slots is OPEN, for agents that start moving; 0: none. B slots contain S turns
 * of resting agents, and half as many more if all of these are at their final goals. B has no
 * factor in common with n: otherwise the same few owners would always give their turns. */
static int open_block(int every, const lease_scope *v, int resting, int settled)
{
    if (!every || !resting) return 0;
    int block = (every * v->n + resting - 1) / resting;
    if (settled == resting) block += block / 2;
    while (common_factor((uint64_t)block, (uint64_t)v->n) > 1) block++;
    return block;
}

/* Whether only start and goal of an agent are known: in the first round, before its first frame. */
static int is_presumed(const dtsa_agent *agent, const lease_scope *v, int k, int64_t slot)
{
    const dtsa_table *table = agent->table;
    return v->a->born == 0 && slot < v->n && table->config->targets_known && k != agent->self &&
           table->sent_slot[k] < 0 && !lease_absent(v, k, slot);
}

/* Whether an agent has something to say when it starts. */
static int sets_out(const dtsa_config *c, int k)
{
    double e2 = 0.0;
    for (int i = 0; i < 3; i++) {
        const double d = c->target[i * c->agents + k] - c->start[i * c->agents + k];
        e2 += d * d;
    }
    return sqrt(e2) > c->r_min;
}

/* Weight of an agent's wait: 1, and 1 more for each 2 cm/s by which its velocity changed in its
 * last frame. After a turn, receivers extrapolate a velocity that the agent may not keep. */
static int32_t need(double innovation)
{
    const double more = NEED * innovation;
    return 1 + (int32_t)(more < MAX_NEED ? more : MAX_NEED);
}

static void find_candidates(const dtsa_agent *agent, const lease_scope *v, int64_t slot,
                            lease_candidates *candidates)
{
    const dtsa_table *table = agent->table;
    const int self = agent->self;
    int resting = 0, settled = 0;
    double innovation = 0.0; /* of the frame that is being made */
    for (int i = 0; i < 3; i++)
        innovation += fabs(agent->velocity[i] - table->sent_v[i * v->n + self]);
    candidates->last = (int64_t *)(void *)table->scratch;
    candidates->next = candidates->last + v->n;
    candidates->need = (int32_t *)(void *)(candidates->next + v->n);
    candidates->gap = (uint16_t *)(candidates->need + v->n);
    candidates->able = (uint8_t *)(candidates->gap + v->window);
    candidates->rests = candidates->able + v->n;
    candidates->final = candidates->rests + v->n;
    candidates->list = candidates->final + v->n;
    candidates->alive = candidates->members = 0;
    for (int k = 0; k < v->n; k++) {
        const int presumed = is_presumed(agent, v, k, slot);
        const int alive = k == self || presumed || lease_alive(v, k, slot);
        const int quiet = k == self ? v->a->probation : v->quiet[k];
        const int says = presumed ? sets_out(table->config, k) : table->in_ap[k];
        const int moving = k == self ? v->a->moving : says;
        candidates->able[k] =
            k == self ? moving : alive && moving && !quiet && v->miss[k] < LEASE_MISSED;
        candidates->rests[k] = alive && !moving && !quiet;
        if (candidates->able[k]) candidates->list[candidates->members++] = (uint8_t)k;
        candidates->alive += alive;
        resting += candidates->rests[k];
        candidates->final[k] =
            candidates->rests[k] && (k == self ? agent->final : presumed || v->settled[k]);
        settled += candidates->final[k];
        candidates->last[k] = table->sent_slot[k] < 0 ? slot - v->n : table->sent_slot[k];
        candidates->need[k] = need(k == self ? innovation : table->innovation[k]);
    }
    candidates->informed = slot >= v->n || table->config->targets_known;
    candidates->block = open_block(table->config->lease.open_every, v, resting, settled);
}

/* Number of consecutive ids before this agent's that are absent. */
static int count_absent_before(const lease_scope *v, int64_t slot)
{
    int count = 0;
    while (count < v->n - 1 && lease_absent(v, (v->self - 1 - count + v->n) % v->n, slot)) count++;
    return count;
}

/* Worth of a turn to an agent: the slots since its frame before, times the slots until its next one
 * (both limited), times its need.
 *
 * next: slot in which it is predicted to send after the turn. */
static long worth(const lease_scope *v, const lease_candidates *candidates, int k, int64_t turn,
                  int64_t next)
{
    const int64_t wait = turn - candidates->last[k], rest = next - turn;
    return (wait <= v->n ? (long)wait : v->n + 1) *
           (rest < candidates->members ? (long)rest : candidates->members) * candidates->need[k];
}

/* The agent to which a turn is worth most. -1: no agent is able. */
static int choose_lessee(const lease_scope *v, const lease_candidates *candidates, int64_t turn)
{
    int best = -1;
    long most = 0;
    for (int i = 0; i < candidates->members; i++) {
        const int k = candidates->list[i];
        const long value = worth(v, candidates, k, turn, candidates->next[k]);
        if (best >= 0 && value <= most) continue;
        best = k;
        most = value;
    }
    return best;
}

/* Whether a turn is one that its owner gives away, as far as is known. */
static int is_spare(const lease_scope *v, const lease_candidates *candidates, int64_t turn)
{
    const int owner = (int)(turn % v->n);
    if (!candidates->rests[owner] || turn < v->n) return 0;
    return candidates->final[owner] ? !lease_is_main(v, turn) : !lease_is_anchor(v, turn);
}

/* In each block, the first turn that its owner gives away is OPEN: for agents that start moving. */
static int is_open(const lease_scope *v, const lease_candidates *candidates, int64_t turn)
{
    if (!candidates->block) return 0;
    for (int64_t t = turn - 1; t >= turn - turn % candidates->block && t >= turn - 2 * v->n; t--)
        if (is_spare(v, candidates, t)) return 0;
    return 1;
}

/* Fills next and gap from the leases of the coming turns.
 *
 * turns: their number; n more than the turns whose worth is needed suffice. */
static void find_next_turns(const lease_scope *v, lease_candidates *candidates, int64_t slot,
                            int turns)
{
    for (int k = 0; k < v->n; k++) candidates->next[k] = INT64_MAX;
    for (int64_t t = slot + (turns < v->window ? turns : v->window - 1); t > slot; t--) {
        const int k = lease_scheduled(v, t);
        if (k < 0) continue;
        const int64_t rest = candidates->next[k] - t;
        candidates->gap[t % v->window] = (uint16_t)(rest < UINT16_MAX ? rest : UINT16_MAX);
        candidates->next[k] = t;
    }
}

/* Predicts the senders of the slots from .. turn - 1: moves last and next forward. */
static void predict_senders(const lease_scope *v, lease_candidates *candidates, int64_t from,
                            int64_t turn)
{
    for (int64_t t = from; t < turn; t++) {
        const int k = lease_scheduled(v, t);
        if (k < 0) continue;
        if (candidates->next[k] == t) candidates->next[k] = t + candidates->gap[t % v->window];
        candidates->last[k] = t;
    }
}

/* Id of the agent to which a turn is given, or LEASE_OPEN; LEASE_NONE: its owner keeps it.
 *
 * from: the first slot whose sender has not been predicted; `slot` + 1 at first. */
static uint8_t choose_new_lessee(const lease_scope *v, lease_candidates *candidates, int64_t slot,
                                 int64_t turn, int64_t *from)
{
    const int mine = turn % v->n == v->self;
    if (mine && is_open(v, candidates, turn)) return LEASE_OPEN;
    if (!candidates->members || !(mine || v->a->deaf <= LEASE_DEAF)) return LEASE_NONE;
    if (*from == slot + 1) find_next_turns(v, candidates, slot, v->window - 1);
    predict_senders(v, candidates, *from, turn);
    *from = turn;
    return (uint8_t)(choose_lessee(v, candidates, turn) + 1);
}

/* Number of its next turns that an agent gives away. */
static int lease_depth(const dtsa_agent *agent, const lease_scope *v,
                       const lease_candidates *candidates, int64_t slot)
{
    const dtsa_lease_config *c = &agent->table->config->lease;
    const lease_agent *a = v->a;
    if (a->idle_since < 0 || !candidates->members || a->deaf > LEASE_DEAF) return 0;
    if (candidates->members > c->share * candidates->alive) return 0;
    if (agent->final) return candidates->informed ? v->main : 1;
    const double turns = c->depth_rate * (double)(slot - a->idle_since) / v->n;
    return turns < v->every ? (int)turns : v->every;
}

/* Gives away turns, and writes the leases of own and adopted turns to the frame of an own turn. */
static void issue_leases(const dtsa_agent *agent, lease_scope *v, int64_t slot, extended_frame *e)
{
    int64_t turns[LEASE_ROOM];
    lease_candidates candidates;
    const int count = lease_turns(v, slot, e->c_s, turns, LEASE_ROOM);
    int64_t from = slot + 1;
    find_candidates(agent, v, slot, &candidates);
    const int adopted = v->a->idle_since >= 0 ? v->every : 1;
    int own = e->leaving ? 0 : lease_depth(agent, v, &candidates, slot);
    for (int i = 0; i < count; i++) {
        const int64_t turn = turns[i];
        const int mine = turn % v->n == v->self;
        uint8_t *lessee = &v->lessee[turn % v->window];
        if (mine && !agent->final && lease_is_anchor(v, turn)) own = 0;
        const int rounds = (int)((turn - slot + v->n - 1) / v->n); /* ahead, rounded up */
        if (*lessee == LEASE_NONE && !v->a->probation && rounds <= (mine ? own : adopted)) {
            *lessee = choose_new_lessee(v, &candidates, slot, turn, &from);
            if (*lessee != LEASE_NONE) v->issuer[turn % v->window] = (uint8_t)(v->self + 1);
        }
        e->leases[i] = *lessee;
        if (*lessee != LEASE_NONE) e->lease_count = i + 1;
    }
}

/* The agent to which this agent hands on a leased turn: always if it rests, else only if the turn
 * is worth much more to the other. -1: it keeps the turn. Never the owner, which gave it away. */
static int choose_next_lessee(const lease_scope *v, const lease_candidates *candidates, int idle,
                              int64_t turn)
{
    const int k = choose_lessee(v, candidates, turn);
    if (k < 0 || k == v->self || k == turn % v->n) return -1;
    const long own = worth(v, candidates, v->self, turn, turn + candidates->gap[turn % v->window]);
    const long others = worth(v, candidates, k, turn, candidates->next[k]);
    return idle || others >= HAND_ON_FACTOR * own ? k : -1;
}

/* Hands a turn on to another agent, by its index. */
static void hand_turn_on(lease_scope *v, lease_candidates *candidates, int64_t turn, int k)
{
    if (candidates->next[v->self] == turn)
        candidates->next[v->self] = turn + candidates->gap[turn % v->window];
    v->lessee[turn % v->window] = (uint8_t)(k + 1);
    v->issuer[turn % v->window] = LEASE_HANDED;
}

/* Hands on turns leased to this agent. A resting agent hands on all within reach, but its last one,
 * in which it can hand on further turns; beyond the relay's reach all go to the one agent to which
 * the first of them is worth most. A moving agent hands on those that are worth much more to
 * another one. The next slot's turn is kept: frames may arrive late.
 *
 * -> mask of the turns handed on, as in relay_mask; those beyond its reach are in e->far_*. */
static uint32_t hand_on_turns(const dtsa_agent *agent, lease_scope *v, int64_t slot,
                              extended_frame *e)
{
    const dtsa_lease_config *c = &agent->table->config->lease;
    const int idle = v->a->idle_since >= 0, mine = v->self + 1;
    const int reach = idle && e->lease_count <= SECTION_BYTES ? FAR_REACH : RELAY_REACH;
    int64_t last = slot + (reach < v->window - 1 ? reach : v->window - 1), from = slot + 1;
    int count = 0, far_lessee = -1;
    uint32_t mask = 0;
    lease_candidates candidates;
    if (!c->open_every || !c->adoption || v->a->probation || v->a->deaf > LEASE_DEAF) return 0;
    while (last > slot + 1 && lease_scheduled(v, last) != v->self) last--;
    for (int64_t turn = slot + 2; turn < last + !idle; turn++) {
        const int d = (int)(turn - slot), far = d > RELAY_REACH;
        if (v->lessee[turn % v->window] != mine || (!far && count == RELAY_IDS)) continue;
        if (from == slot + 1) {
            find_candidates(agent, v, slot, &candidates);
            find_next_turns(v, &candidates, slot, reach + v->n);
            candidates.last[v->self] = slot;
        }
        if (!far || far_lessee < 0) {
            predict_senders(v, &candidates, from, turn);
            from = turn;
        }
        const int k =
            far && far_lessee >= 0 ? far_lessee : choose_next_lessee(v, &candidates, idle, turn);
        if (k < 0 || k == turn % v->n) continue;
        hand_turn_on(v, &candidates, turn, k);
        if (far) {
            far_lessee = k;
            e->far_id = (uint8_t)(k + 1);
            e->far_mask[(d - RELAY_REACH - 1) >> 3] |= (uint8_t)(1u << ((d - RELAY_REACH - 1) & 7));
        } else {
            mask |= 1u << (d - 1);
            count++;
        }
    }
    return mask;
}

/* Writes the relay section: the turns handed on in this frame, and the next known leases. */
static void relay_leases(const lease_scope *v, int64_t slot, uint32_t handed, extended_frame *e)
{
    int count = 0;
    for (uint32_t left = handed; left; left &= left - 1) count++;
    e->relay_mask = handed;
    for (int d = 1; d <= RELAY_REACH && d < v->window && count < RELAY_IDS; d++) {
        const int64_t turn = slot + d;
        const int in_leases = e->lease_count && turn % v->n == v->self; /* in the lease bytes */
        if (v->lessee[turn % v->window] == LEASE_NONE || in_leases || handed >> (d - 1) & 1)
            continue;
        e->relay_mask |= 1u << (d - 1);
        count++;
    }
    for (int d = 1, i = 0; d <= RELAY_REACH; d++)
        if (e->relay_mask >> (d - 1) & 1) e->relay_ids[i++] = v->lessee[(slot + d) % v->window];
}

void lease_fill(dtsa_agent *agent, int64_t slot, extended_frame *e)
{
    lease_scope v = lease_of(agent);
    const int own_turn = slot % v.n == v.self;
    e->probation = v.a->probation;
    e->leaving = own_turn && agent->present == PRESENT_LEAVING;
    v.a->leaving = (uint8_t)e->leaving;
    v.a->spoke = slot;
    if (agent->table->config->lease.adoption && !v.a->probation && !e->leaving)
        e->c_s = count_absent_before(&v, slot);
    if (own_turn) issue_leases(agent, &v, slot, e);
    relay_leases(&v, slot, hand_on_turns(agent, &v, slot, e), e);
}
