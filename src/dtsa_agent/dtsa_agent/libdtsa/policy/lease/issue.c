/* Policy lease: what an agent says about turns: those it gives away, and those it knows to be given
 * away. */
#include <math.h>
#include <string.h>

#include "lease.h"

static const double NEED = 50.0, MOST_NEED = 6000.0; /* NEED: s/m */

enum { MORE = 2 }; /* a mover hands on turns that are worth so many times as much to another one */

typedef struct {
    int alive;       /* N_alive: me and those heard of lately */
    int members;     /* N_p: those in A_p that do not miss their turns */
    int block;       /* one turn in so many is OPEN, 0: none */
    int informed;    /* all have spoken, or all know where all want to be */
    int64_t *last;   /* (n) last slot in which each sent, or is foreseen to send */
    int64_t *next;   /* (n) next slot in which each is known to send */
    uint16_t *again; /* (w) slots from each turn to the next one of the same agent */
    int32_t *need;   /* (n) weight of each: more the more its velocity has just changed */
    uint8_t *able;   /* (n) may be given a turn */
    uint8_t *rests;  /* (n) gives its turns away, as far as is known */
    uint8_t *sure;   /* (n) rests and is settled: gives anchors away, but for main ones */
    uint8_t *list;   /* (members) those able */
} electorate;

/* Slots of which one turn goes to agents that wake: S turns of those that rest lie in so many; half
 * as many more where all of them are settled. No factor in common with n, or the same few owners
 * would always pay. */
static int open_block(int every, const lease_scope *v, int resting, int settled)
{
    if (!every || !resting) return 0;
    int block = (every * v->n + resting - 1) / resting;
    if (settled == resting) block += block / 2;
    while (common_factor((uint64_t)block, (uint64_t)v->n) > 1) block++;
    return block;
}

/* Whether nothing is known of an agent but where it starts and wants to be: in the first round. */
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

/* How much the wait of an agent counts: 1, and 1 more for each 2 cm/s by which its velocity has
 * changed in its last frame. It has just turned, and others extrapolate a velocity that it may not
 * keep. */
static int32_t need(double innovation)
{
    const double more = NEED * innovation;
    return 1 + (int32_t)(more < MOST_NEED ? more : MOST_NEED);
}

static void count_electorate(const dtsa_agent *agent, const lease_scope *v, int64_t slot,
                             electorate *who)
{
    const dtsa_table *table = agent->table;
    const int self = agent->self;
    int resting = 0, settled = 0;
    double innovation = 0.0; /* of the frame that is being made */
    for (int i = 0; i < 3; i++)
        innovation += fabs(agent->velocity[i] - table->sent_v[i * v->n + self]);
    who->last = (int64_t *)(void *)table->scratch;
    who->next = who->last + v->n;
    who->need = (int32_t *)(void *)(who->next + v->n);
    who->again = (uint16_t *)(who->need + v->n);
    who->able = (uint8_t *)(who->again + v->window);
    who->rests = who->able + v->n;
    who->sure = who->rests + v->n;
    who->list = who->sure + v->n;
    who->alive = who->members = 0;
    for (int k = 0; k < v->n; k++) {
        const int presumed = is_presumed(agent, v, k, slot);
        const int alive = k == self || presumed || lease_alive(v, k, slot);
        const int quiet = k == self ? v->a->probation : v->quiet[k];
        const int says = presumed ? sets_out(table->config, k) : table->in_ap[k];
        const int moving = k == self ? v->a->moving : says;
        who->able[k] = k == self ? moving : alive && moving && !quiet && v->miss[k] < LEASE_MISSED;
        who->rests[k] = alive && !moving && !quiet;
        if (who->able[k]) who->list[who->members++] = (uint8_t)k;
        who->alive += alive;
        resting += who->rests[k];
        who->sure[k] = who->rests[k] && (k == self ? agent->final : presumed || v->settled[k]);
        settled += who->sure[k];
        who->last[k] = table->sent_slot[k] < 0 ? slot - v->n : table->sent_slot[k];
        who->need[k] = need(k == self ? innovation : table->innovation[k]);
    }
    who->informed = slot >= v->n || table->config->targets_known;
    who->block = open_block(table->config->lease.open_every, v, resting, settled);
}

/* Number of consecutive ids before me that nobody has heard of for long. */
static int count_absent_before(const lease_scope *v, int64_t slot)
{
    int count = 0;
    while (count < v->n - 1 && lease_absent(v, (v->self - 1 - count + v->n) % v->n, slot)) count++;
    return count;
}

/* What a turn is worth to an agent: its wait before it, times the wait that follows, as far as that
 * is short, times its need.
 *
 * next: slot in which it is known to send after the turn. */
static long worth(const lease_scope *v, const electorate *who, int k, int64_t turn, int64_t next)
{
    const int64_t wait = turn - who->last[k], rest = next - turn;
    return (wait <= v->n ? (long)wait : v->n + 1) *
           (rest < who->members ? (long)rest : who->members) * who->need[k];
}

/* To whom a turn is worth most. -1: nobody is able. */
static int choose_lessee(const lease_scope *v, const electorate *who, int64_t turn)
{
    int best = -1;
    long most = 0;
    for (int i = 0; i < who->members; i++) {
        const int k = who->list[i];
        const long value = worth(v, who, k, turn, who->next[k]);
        if (best >= 0 && value <= most) continue;
        best = k;
        most = value;
    }
    return best;
}

/* Whether a turn is one that its owner gives away, as far as is known. */
static int is_spare(const lease_scope *v, const electorate *who, int64_t turn)
{
    const int owner = (int)(turn % v->n);
    if (!who->rests[owner] || turn < v->n) return 0;
    return who->sure[owner] ? !lease_is_main(v, turn) : !lease_is_anchor(v, turn);
}

/* One turn in each block is for those who wake: the first one that its owner gives away. */
static int is_open(const lease_scope *v, const electorate *who, int64_t turn)
{
    if (!who->block) return 0;
    for (int64_t t = turn - 1; t >= turn - turn % who->block && t >= turn - 2 * v->n; t--)
        if (is_spare(v, who, t)) return 0;
    return 1;
}

/* Notes when each will send next, and after each turn again, as far as is known.
 *
 * turns: so many are looked at; n more than those whose worth is asked for are enough. */
static void look_ahead(const lease_scope *v, electorate *who, int64_t slot, int turns)
{
    for (int k = 0; k < v->n; k++) who->next[k] = INT64_MAX;
    for (int64_t t = slot + (turns < v->window ? turns : v->window - 1); t > slot; t--) {
        const int k = lease_scheduled(v, t);
        if (k < 0) continue;
        const int64_t rest = who->next[k] - t;
        who->again[t % v->window] = (uint16_t)(rest < UINT16_MAX ? rest : UINT16_MAX);
        who->next[k] = t;
    }
}

/* Notes who will send in the slots before a turn, as far as is known. from: the first of them. */
static void foresee(const lease_scope *v, electorate *who, int64_t from, int64_t turn)
{
    for (int64_t t = from; t < turn; t++) {
        const int k = lease_scheduled(v, t);
        if (k < 0) continue;
        if (who->next[k] == t) who->next[k] = t + who->again[t % v->window];
        who->last[k] = t;
    }
}

/* To whom a turn is given; LEASE_NONE: to nobody, it is kept.
 *
 * from: the first slot whose sender has not been foreseen; `slot` + 1 at first. */
static uint8_t choose_heir(const lease_scope *v, electorate *who, int64_t slot, int64_t turn,
                           int64_t *from)
{
    const int mine = turn % v->n == v->self;
    if (mine && is_open(v, who, turn)) return LEASE_OPEN;
    if (!who->members || !(mine || v->a->deaf <= LEASE_DEAF)) return LEASE_NONE;
    if (*from == slot + 1) look_ahead(v, who, slot, v->window - 1);
    foresee(v, who, *from, turn);
    *from = turn;
    return (uint8_t)(choose_lessee(v, who, turn) + 1);
}

/* How many of its next turns an agent gives away. */
static int depth(const dtsa_agent *agent, const lease_scope *v, const electorate *who, int64_t slot)
{
    const dtsa_lease_config *c = &agent->table->config->lease;
    const lease_agent *a = v->a;
    if (a->idle_since < 0 || !who->members || a->deaf > LEASE_DEAF) return 0;
    if (who->members > c->share * who->alive) return 0;
    if (agent->final) return who->informed ? v->main : 1;
    const double turns = c->depth_rate * (double)(slot - a->idle_since) / v->n;
    return turns < v->every ? (int)turns : v->every;
}

/* Writes down which turns the frame of an own turn gives away, and gives away more of them. */
static void issue(const dtsa_agent *agent, lease_scope *v, int64_t slot, extended_frame *e)
{
    int64_t turns[LEASE_ROOM];
    electorate who;
    const int count = lease_turns(v, slot, e->c_s, turns, LEASE_ROOM);
    int64_t from = slot + 1;
    count_electorate(agent, v, slot, &who);
    const int adopted = v->a->idle_since >= 0 ? v->every : 1;
    int own = e->leaving ? 0 : depth(agent, v, &who, slot);
    for (int i = 0; i < count; i++) {
        const int64_t turn = turns[i];
        const int mine = turn % v->n == v->self;
        uint8_t *given = &v->lessee[turn % v->window];
        if (mine && !agent->final && lease_is_anchor(v, turn)) own = 0;
        const int rounds = (int)((turn - slot + v->n - 1) / v->n); /* ahead, rounded up */
        if (*given == LEASE_NONE && !v->a->probation && rounds <= (mine ? own : adopted)) {
            *given = choose_heir(v, &who, slot, turn, &from);
            if (*given != LEASE_NONE) v->issuer[turn % v->window] = (uint8_t)(v->self + 1);
        }
        e->leases[i] = *given;
        if (*given != LEASE_NONE) e->lease_count = i + 1;
    }
}

/* To whom this agent hands a turn on that it was given: if it rests, or the turn is worth much more
 * to that one. -1: to nobody. Its owner has given it away. */
static int choose_next(const lease_scope *v, const electorate *who, int idle, int64_t turn)
{
    const int k = choose_lessee(v, who, turn);
    if (k < 0 || k == v->self || k == turn % v->n) return -1;
    const long own = worth(v, who, v->self, turn, turn + who->again[turn % v->window]);
    return idle || worth(v, who, k, turn, who->next[k]) >= MORE * own ? k : -1;
}

/* Hands a turn on to another agent, by its index. */
static void hand(lease_scope *v, electorate *who, int64_t turn, int k)
{
    if (who->next[v->self] == turn) who->next[v->self] = turn + who->again[turn % v->window];
    v->lessee[turn % v->window] = (uint8_t)(k + 1);
    v->issuer[turn % v->window] = LEASE_HANDED;
}

/* Hands on turns that this agent was given. If it rests: all within reach that come before its last
 * turn there, in which it can hand on further ones; beyond the relay's reach all to one agent, to
 * whom the first of them is worth most. If it moves: those that are worth much more to another one. Not
 * the next slot's: frames may arrive late.
 *
 * -> mask of the turns handed on, as in relay_mask; e->far_* says those beyond. */
static uint32_t hand_on(const dtsa_agent *agent, lease_scope *v, int64_t slot, extended_frame *e)
{
    const dtsa_lease_config *c = &agent->table->config->lease;
    const int idle = v->a->idle_since >= 0, mine = v->self + 1;
    const int reach = idle && e->lease_count <= SECTION_BYTES ? FAR_REACH : RELAY_REACH;
    int64_t last = slot + (reach < v->window - 1 ? reach : v->window - 1), from = slot + 1;
    int count = 0, heir = -1;
    uint32_t mask = 0;
    electorate who;
    if (!c->open_every || !c->adoption || v->a->probation || v->a->deaf > LEASE_DEAF) return 0;
    while (last > slot + 1 && lease_scheduled(v, last) != v->self) last--;
    for (int64_t turn = slot + 2; turn < last + !idle; turn++) {
        const int d = (int)(turn - slot), far = d > RELAY_REACH;
        if (v->lessee[turn % v->window] != mine || (!far && count == RELAY_IDS)) continue;
        if (from == slot + 1) {
            count_electorate(agent, v, slot, &who);
            look_ahead(v, &who, slot, reach + v->n);
            who.last[v->self] = slot;
        }
        if (!far || heir < 0) {
            foresee(v, &who, from, turn);
            from = turn;
        }
        const int k = far && heir >= 0 ? heir : choose_next(v, &who, idle, turn);
        if (k < 0 || k == turn % v->n) continue;
        hand(v, &who, turn, k);
        if (far) {
            heir = k;
            e->far_id = (uint8_t)(k + 1);
            e->far_mask[(d - RELAY_REACH - 1) >> 3] |= (uint8_t)(1u << ((d - RELAY_REACH - 1) & 7));
        } else {
            mask |= 1u << (d - 1);
            count++;
        }
    }
    return mask;
}

/* Relays leases: those that are handed on now, and the next ones. */
static void relay(const lease_scope *v, int64_t slot, uint32_t handed, extended_frame *e)
{
    int count = 0;
    for (uint32_t rest = handed; rest; rest &= rest - 1) count++;
    e->relay_mask = handed;
    for (int d = 1; d <= RELAY_REACH && d < v->window && count < RELAY_IDS; d++) {
        const int64_t turn = slot + d;
        const int said = e->lease_count && turn % v->n == v->self; /* by the lease bytes */
        if (v->lessee[turn % v->window] == LEASE_NONE || said || handed >> (d - 1) & 1) continue;
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
    if (own_turn) issue(agent, &v, slot, e);
    relay(&v, slot, hand_on(agent, &v, slot, e), e);
}
