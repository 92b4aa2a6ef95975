/* Explores policy lease state by state: libdtsa's own code, with every choice of the world tried in
 * every slot.
 *
 * A state is what the agents remember and what can make a difference: who is there, in probation,
 * past an own anchor, waking (with OPEN turns only), and what is known of turns that can be leased;
 * and a ledger of what was given away in frames. All that rests on ages and contents is free, in every
 * slot and for each agent on its own, and so covers all that ages and contents can be:
 *
 *   who has something to say, and who knows that it will rest          (goals)
 *   whether a turn is given away, and to whom of those not thought dead
 *                                              (contents; choose_lessee is prove_lessee)
 *   whether a turn is handed on, and to whom           (contents; choose_next_lessee is prove_next)
 *   which turns are OPEN                               (contents; is_open is prove_open)
 *   whom a speaker thinks dead, and whether a hearer thought it dead
 *                                              (all that absence, silence and gossip can lead to)
 *   whether the wait that ends probation with adoption is over         (ages)
 *   whether an OPEN turn is taken, whether gossip names a waker        (draws, gossip)
 *   which one of those that send each receiver hears, or nothing       (loss)
 *   restarts, deaths (or leaving), returns, frames that claim somebody dead:
 *                                              as often as the budgets say
 *
 * Breadth first, states compared byte by byte, until there are no new ones.
 *
 *     prove AGENTS M KM S ADOPTION RESTARTS DEATHS RETURNS CLAIMS MOST_STATES
 *
 * prints one line of words and numbers, or the rule that is broken; exit code 1 then. A budget
 * below 0: any number.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "policy/lease/lease.h"

enum { MOST_AGENTS = 5, MOST_WINDOW = 64, MOST_BYTES = 128, MOST_CHOICES = 64 };

/* ---- choices: a tape that is wound through all its values ---- */

static int chosen[MOST_CHOICES], options[MOST_CHOICES], used;

static int choose(int count)
{
    if (used == MOST_CHOICES) abort();
    options[used] = count;
    return chosen[used++];
}

/* The next combination; 0: there are no more. */
static int wind(void)
{
    while (used > 0 && chosen[used - 1] + 1 >= options[used - 1]) chosen[--used] = 0;
    if (!used) return 0;
    chosen[used - 1]++;
    used = 0;
    return 1;
}

int prove_lessee(const uint8_t *able, int count);

/* In the place of choose_lessee; -1: a turn is not given away. */
int prove_lessee(const uint8_t *able, int count)
{
    int who[MOST_WINDOW] = {-1}, found = 1;
    for (int k = 0; k < count; k++)
        if (able[k]) who[found++] = k;
    return who[choose(found)];
}

/* In the place of choose_next_lessee. */
int prove_next(const uint8_t *able, int self, int count);

int prove_next(const uint8_t *able, int self, int count)
{
    int who[MOST_WINDOW] = {-1}, found = 1;
    for (int k = 0; k < count; k++)
        if (able[k] && k != self) who[found++] = k;
    return who[choose(found)];
}

int prove_open(void); /* in the place of is_open */

uint64_t mix64(uint64_t x) { return x; } /* digests of tables do not count */

double draw_uniform(uint64_t key, uint64_t what)
{
    (void)key;
    (void)what;
    return choose(2) ? 1.0 : 0.0;
}

/* ---- the world ---- */

enum { RESTART, DEATH, RETURN, CLAIM }; /* budgets */
enum { PATIENCE = 6 };                  /* slots; only whether it is over counts */

typedef struct ledger {
    uint8_t owner;     /* what its owner gave the turn away as */
    uint8_t others;    /* bit k: an adopter gave it to agent k */
    uint8_t named;     /* bit k: it was given or handed on to agent k */
    uint8_t holders;   /* bit k: to agent k last, one for each that gave it away */
    uint8_t forgotten; /* bit k: agent k has handed it on, in an earlier life */
} ledger;

static dtsa_config config;
static dtsa_agent *agents[MOST_AGENTS];
static uint8_t *memory; /* of all agents */
static size_t each;
static int n, period, reach; /* reach: leases speak of turns less far than this */
static int64_t slot, base;
static int left[4];              /* of each budget; below 0: any number */
static ledger book[MOST_WINDOW]; /* of turn t: book[t % MOST_WINDOW] */
static const char *broken;

static void start(void)
{
    static double places[6 * MOST_AGENTS];
    config.agents = n;
    config.slot_s = 0.01;
    config.steps = config.c_r = 1;
    config.policy = DTSA_POLICY_LEASE;
    config.estimator = DTSA_ESTIMATE_LINEAR;
    config.avoider = DTSA_AVOID_NONE;
    config.profile = DTSA_PROFILE_EXTENDED;
    config.r_min = 0.3;
    config.position_step = 0.002;
    config.lease.share = 1.0;
    config.targets_known = 1; /* who is not heard of is known to set out: leases of any depth from
                                 the first round on */
    config.lease.patience = PATIENCE;
    config.start = places;
    config.target = places + 3 * n;
    for (int k = 0; k < n; k++) places[3 * n + k] = 5.0;
    each = dtsa_agent_bytes(&config);
    memory = malloc(each * (size_t)n);
    for (int k = 0; k < n; k++) {
        agents[k] = dtsa_agent_start(memory + each * (size_t)k, each, &config, k + 1);
        agents[k]->goal[0] = 5.0;
    }
}

static int anchor(int64_t turn) { return (turn / n + turn % n) % config.lease.anchor_every == 0; }

static int main_anchor(int64_t turn)
{
    return (turn / n + turn % n) % config.lease.main_every == 0;
}

int prove_open(void) { return config.lease.open_every ? choose(2) : 0; }

/* ---- states as bytes ---- */

static uint8_t *at;

static void put(int64_t value) { *at++ = (uint8_t)value; }

static int64_t take(void) { return *at++; }

/* Turns are handed on where there is adoption, and there are OPEN turns. */
static int hands_on(void) { return config.lease.open_every && config.lease.adoption; }

/* An entry of an agent's ring. Without adoption the agent that gave a turn away makes no
 * difference: it was its owner. */
static int entry_byte(int lessee, int issuer)
{
    const int by = !config.lease.adoption ? 0 : issuer == LEASE_HANDED ? 7 : issuer;
    return (lessee == LEASE_OPEN ? 7 : lessee) | by << 3;
}

/* Bit of an agent, by its id; OPEN and 0: none. */
static int bit_of(int id) { return id && id != LEASE_OPEN ? 1 << (id - 1) : 0; }

static int pack(uint8_t *out)
{
    at = out;
    put(slot < n ? slot : n + slot % period);
    for (int i = 0; i < 4; i++) put(left[i]);
    for (int64_t t = slot; t < slot + reach; t++) {
        if (main_anchor(t)) continue;
        put(book[t % MOST_WINDOW].owner);
        if (config.lease.adoption) put(book[t % MOST_WINDOW].others);
        if (!hands_on()) continue;
        put(book[t % MOST_WINDOW].named);
        put(book[t % MOST_WINDOW].holders);
        put(book[t % MOST_WINDOW].forgotten);
    }
    for (int k = 0; k < n; k++) {
        const lease_scope v = lease_of(agents[k]);
        const lease_agent *a = v.a;
        const int waking = config.lease.open_every && a->woke >= 0;
        put(agents[k]->present | a->started << 2 | a->probation << 3 |
            (a->probation && a->anchored) << 4 | (a->started && waking) << 5);
        for (int64_t t = slot; t < slot + reach; t++)
            put(a->started ? entry_byte(v.lessee[t % v.window], v.issuer[t % v.window]) : 0);
    }
    return (int)(at - out);
}

static void unpack(const uint8_t *in)
{
    at = (uint8_t *)(uintptr_t)in;
    slot = take();
    if (slot >= n) slot = base + (slot - n);
    for (int i = 0; i < 4; i++) left[i] = (int8_t)take();
    memset(book, 0, sizeof book);
    for (int64_t t = slot; t < slot + reach; t++) {
        if (main_anchor(t)) continue;
        ledger *entry = &book[t % MOST_WINDOW];
        entry->owner = (uint8_t)take();
        if (config.lease.adoption) entry->others = (uint8_t)take();
        entry->named = entry->holders = (uint8_t)(entry->others | bit_of(entry->owner));
        if (!hands_on()) continue;
        entry->named = (uint8_t)take();
        entry->holders = (uint8_t)take();
        entry->forgotten = (uint8_t)take();
    }
    for (int k = 0; k < n; k++) {
        agent_forget(agents[k]);
        const lease_scope v = lease_of(agents[k]);
        lease_agent *a = v.a;
        const int flags = (int)take();
        agents[k]->present = flags & 3;
        agents[k]->frame_length = 0;
        a->started = flags >> 2 & 1;
        a->probation = flags >> 3 & 1;
        a->anchored = flags >> 4 & 1;
        a->woke = flags >> 5 & 1 ? slot - 1 : -1;
        a->idle_since = -1;
        a->born = a->now = a->claimed = slot - 1;
        for (int64_t t = slot; t < slot + reach; t++) {
            const int byte = (int)take();
            v.lessee[t % v.window] = (uint8_t)((byte & 7) == 7 ? LEASE_OPEN : byte & 7);
            v.issuer[t % v.window] = (uint8_t)(byte >> 3 == 7 ? LEASE_HANDED : byte >> 3);
        }
        for (int i = 0; i < n; i++) v.heard[i] = slot - 1;
    }
}

/* ---- rules (docs/reference/protocol.md, invariants) ---- */

static void rule(int holds, const char *name)
{
    if (!holds && !broken) broken = name;
}

/* To whom a frame says that a turn is given, 0: it says nothing of it. `i` of the relay's ids have
 * been read. */
static int said_of(const extended_frame *e, int d, int *i)
{
    if (d <= RELAY_REACH) return e->relay_mask >> (d - 1) & 1 ? e->relay_ids[(*i)++] : 0;
    const int b = d - RELAY_REACH - 1;
    return e->far_mask[b >> 3] >> (b & 7) & 1 ? e->far_id : 0;
}

/* Turns that a frame hands on: whose turn it is names another one. One that does not know yet that
 * it was named relays an earlier one, which then takes the turn again. */
static void write_handed(int sender, const extended_frame *e)
{
    for (int d = 1, i = 0; d < MOST_WINDOW && d <= FAR_REACH; d++) {
        const int lessee = said_of(e, d, &i);
        if (!lessee) continue;
        const int64_t turn = slot + d;
        ledger *entry = &book[turn % MOST_WINDOW];
        if (!(entry->holders >> sender & 1) || lessee == LEASE_OPEN ||
            entry->holders & bit_of(lessee))
            continue;                 /* relayed */
        if (lessee - 1 == turn % n) { /* an adopter may have given it the turn */
            rule(entry->named & bit_of(lessee), "3: hands no turn on to its owner");
            continue;
        }
        rule(hands_on(), "2: hands a turn on where nobody may");
        rule(!main_anchor(turn), "4: hands a main anchor on");
        entry->holders = (uint8_t)((entry->holders & ~(1 << sender)) | bit_of(lessee));
        entry->named |= (uint8_t)bit_of(lessee);
    }
}

/* Turns that a frame gives away. */
static void write_given(int sender, const extended_frame *e)
{
    rule(slot % n == sender, "2: gives away in an own turn only");
    rule(config.lease.adoption || !e->c_s, "2: adopts where there is no adoption");
    int place = 0, own = 1;
    for (int j = 1; j <= config.lease.main_every; j++)
        for (int i = e->c_s; i >= 0; i--) {
            const int64_t turn = slot + (int64_t)j * n - i;
            ledger *entry = &book[turn % MOST_WINDOW];
            if (main_anchor(turn) && !i) own = 0;
            if (i ? anchor(turn) : !own) continue;
            const int given = place < e->lease_count ? e->leases[place++] : 0;
            if (!given) continue;
            if (!i)
                rule(!entry->owner || entry->owner == given || entry->named & bit_of(given),
                     "3: gives a turn away once");
            if (i) entry->others |= (uint8_t)bit_of(given);
            if (i ? entry->named & bit_of(given) : entry->owner) continue; /* said again */
            if (!i) entry->owner = (uint8_t)given;
            entry->named |= (uint8_t)bit_of(given);
            entry->holders |= (uint8_t)bit_of(given);
        }
    rule(place >= e->lease_count || !e->leases[place],
         "4: gives no main anchor away, nothing beyond it");
}

/* A frame's announcements of turns, read without the agents' own code for it. */
static void write_down(int sender, const uint8_t *data)
{
    extended_frame e;
    rule(extended_decode(data, EXTENDED_LENGTH, config.position_step, &e) == FRAME_OK, "frame");
    rule(!e.c_s || !(e.probation || e.leaving),
         "14: claims nobody dead in probation, or when it leaves");
    if (!broken && e.lease_count) write_given(sender, &e);
    if (!broken) write_handed(sender, &e);
}

/* Whether its owner sends in an anchor of which it does not know that it has given it away, in an
 * earlier life. */
static int taken_back(int sender, int probation)
{
    return probation && slot % n == sender && anchor(slot) && !main_anchor(slot);
}

static void judge(int sender, int probation, int64_t woke)
{
    const ledger *entry = &book[slot % MOST_WINDOW];
    const int owner = slot % n == sender;
    const int lent = (entry->holders | entry->forgotten) >> sender & 1;
    if (entry->owner == LEASE_OPEN && !lent)
        rule(woke >= 0 || taken_back(sender, probation), "2: only who wakes takes OPEN turns");
    rule(entry->owner != LEASE_OPEN || config.lease.open_every, "2: OPEN where there is none");
    if (owner)
        rule(!entry->owner || lent || entry->owner == LEASE_OPEN || taken_back(sender, probation),
             "3: does not send in a turn that it gave away");
    else
        rule(entry->owner == LEASE_OPEN || lent, "2: owner, lessee or waker");
    if (probation)
        rule((owner && anchor(slot)) || entry->owner == LEASE_OPEN, "8: probation: anchors only");
}

/* ---- one slot ---- */

/* A choice that happens as often as a budget says. */
static int befalls(int budget)
{
    if (!left[budget] || !choose(2)) return 0;
    if (left[budget] > 0) left[budget]--;
    return 1;
}

/* In its next life an agent does not know the turns that it has handed on. */
static void forget(int k)
{
    for (int64_t t = slot; t < slot + reach; t++) {
        ledger *entry = &book[t % MOST_WINDOW];
        entry->forgotten |= (uint8_t)(entry->named & ~entry->holders & 1 << k);
    }
}

static void happen(int k)
{
    const lease_scope v = lease_of(agents[k]);
    if (!agents[k]->present) {
        agents[k]->present = (uint8_t)befalls(RETURN);
        if (agents[k]->present) forget(k);
    } else if (v.a->started && befalls(RESTART)) {
        agent_forget(agents[k]);
        forget(k);
    } else if (agents[k]->present == 1 && befalls(DEATH)) {
        if (choose(2))
            dtsa_agent_leave(agents[k]);
        else
            dtsa_agent_switch(agents[k], 0);
    } else if (config.lease.open_every && v.a->started && v.a->woke < 0 && choose(2)) {
        v.a->idle_since = slot - 1; /* it wakes in this slot */
    }
}

/* Beliefs and state of a sender. */
static void speak(int k, uint8_t *frame)
{
    dtsa_agent *a = agents[k];
    const lease_scope v = lease_of(a);
    const int own = slot % n == k;
    int dead = 0;
    if (v.a->probation)
        dead = n - 1; /* whatever it thinks, it says nothing of it */
    else if (left[CLAIM])
        dead = choose(n);
    if (dead && !v.a->probation && left[CLAIM] > 0) left[CLAIM]--;
    for (int i = 1; i < n; i++) {
        const int other = (k - i + n) % n;
        v.heard[other] = i <= dead ? slot - PATIENCE - 1 : slot - 1;
        a->table->in_ap[other] = 1;
        v.miss[other] = v.quiet[other] = 0;
    }
    /* moving; idle, all of its turns given away; idle, none of them */
    const int mood = own && !v.a->probation ? choose(dead ? 3 : 2) : 0;
    v.a->moving = mood == 0;
    v.a->idle_since = mood ? slot : -1;
    a->final = mood == 1;
    v.a->deaf = 0;
    a->frame_length = (uint8_t)agent_speak(a, slot, frame);
    memcpy(a->frame, frame, DTSA_FRAME_MAX);
    v.a->idle_since = -1;
    write_down(k, frame);
}

static void hear(int k, const int *senders, int count, uint8_t frames[][DTSA_FRAME_MAX])
{
    const lease_scope v = lease_of(agents[k]);
    const int heard = choose(count + 1);
    if (!heard) return;
    const int sender = senders[heard - 1];
    const uint8_t *data = frames[sender];
    const int c_s = data[2], claimed = c_s != 255 && (sender - k + n) % n <= c_s;
    const int absent = config.lease.adoption && left[CLAIM] && !(data[3] & 2) && choose(2);
    if (absent && left[CLAIM] > 0) left[CLAIM]--;
    v.heard[sender] = absent ? slot - PATIENCE - 1 : slot - 1;
    uint8_t before[MOST_WINDOW];
    for (int64_t t = slot; t < slot + reach; t++) before[t - slot] = v.lessee[t % v.window];
    dtsa_agent_hear(agents[k], slot, data, EXTENDED_LENGTH);
    for (int64_t t = slot; t < slot + reach; t++) {
        const int was = before[t - slot], is = v.lessee[t % v.window];
        rule(was == is || !was || was == sender + 1 || book[t % MOST_WINDOW].others,
             "3: nobody but its lessee changes an entry");
    }
    if (config.lease.open_every && v.a->woke >= 0 && choose(2)) v.a->woke = -1; /* gossip of it */
    if (config.lease.adoption && claimed && v.a->started)
        rule(v.a->probation, "8: who hears itself claimed is in probation");
}

static void finish(int k)
{
    const lease_scope v = lease_of(agents[k]);
    const int past = v.a->anchored || (slot % n == k && main_anchor(slot));
    if (config.lease.adoption && agents[k]->present && v.a->probation && past)
        v.a->claimed = choose(2) ? slot - 2 * n * config.lease.main_every : slot;
    v.a->deaf = 0;
    dtsa_agent_end(agents[k], slot);
}

static void step(void)
{
    uint8_t frames[MOST_AGENTS][DTSA_FRAME_MAX];
    int senders[MOST_AGENTS], count = 0, returned = 0;
    for (int k = 0; k < n; k++) happen(k);
    for (int k = 0; k < n; k++) {
        dtsa_agent *a = agents[k];
        a->frame_length = 0;
        a->decision.sends = 0;
        if (!a->present) continue;
        const lease_scope v = lease_of(a);
        agent_decide(a, slot);
        v.a->attempts = 0;
        if (!a->decision.sends) continue;
        judge(k, v.a->probation, v.a->woke);
        returned |= taken_back(k, v.a->probation);
        speak(k, frames[k]);
        senders[count++] = k;
    }
    const ledger *entry = &book[slot % MOST_WINDOW];
    rule(count < 2 || entry->owner == LEASE_OPEN || entry->others || entry->forgotten || returned,
         "1: at most one sends");
    for (int k = 0; k < n && count; k++)
        if (agents[k]->present && !agents[k]->decision.sends) hear(k, senders, count, frames);
    for (int k = 0; k < n; k++) finish(k);
    book[slot % MOST_WINDOW] = (ledger){0};
    slot++;
}

/* ---- the search ---- */

static uint8_t *states; /* one after the other, `size` bytes each */
static uint32_t *table; /* index of a state + 1 by hash */
static long known, most, places_in_table, steps;
static int size;

/* Unless it is known. */
static void add(const uint8_t *state)
{
    uint64_t hash = 14695981039346656037ULL;
    for (int i = 0; i < size; i++) hash = (hash ^ state[i]) * 1099511628211ULL;
    hash ^= hash >> 29;
    for (long place = (long)(hash % (uint64_t)places_in_table);;
         place = (place + 1) % places_in_table) {
        if (!table[place]) {
            table[place] = (uint32_t)known + 1;
            memcpy(states + known++ * size, state, (size_t)size);
            return;
        }
        if (!memcmp(states + (long)(table[place] - 1) * size, state, (size_t)size)) return;
    }
}

/* -> slots from the start; 0 in *closed: there are states that were not looked at. */
static long search(int *closed)
{
    uint8_t state[MOST_BYTES] = {0};
    long depth = 0, level_end = 1;
    size_t bytes = each * (size_t)n;
    uint8_t *before = malloc(bytes);
    *closed = 0;
    if (!before) return 0;
    size = pack(state);
    add(state);
    for (long i = 0; i < known && !broken; i++) {
        if (i == level_end) {
            depth++;
            level_end = known;
        }
        memset(chosen, 0, sizeof chosen);
        unpack(states + i * size);
        memcpy(before, memory, bytes);
        const int64_t now = slot;
        ledger pages[MOST_WINDOW];
        int budgets[4];
        memcpy(pages, book, sizeof book);
        memcpy(budgets, left, sizeof left);
        do {
            used = 0;
            memcpy(memory, before, bytes);
            memcpy(book, pages, sizeof book);
            memcpy(left, budgets, sizeof left);
            slot = now;
            step();
            steps++;
            if (broken) return depth;
            pack(state);
            if (known == most) return depth;
            add(state);
        } while (wind());
    }
    *closed = 1;
    return depth;
}

int main(int argc, char **argv)
{
    long numbers[10];
    if (argc != 11) return 2;
    for (int i = 0; i < 10; i++) numbers[i] = strtol(argv[i + 1], NULL, 10);
    n = (int)numbers[0];
    if (n < 2 || n > MOST_AGENTS) return 2;
    config.lease = (dtsa_lease_config){.anchor_every = (int)numbers[1],
                                       .main_every = (int)numbers[2],
                                       .open_every = (int)numbers[3],
                                       .adoption = (int)numbers[4]};
    for (int i = 0; i < 4; i++) left[i] = (int)numbers[5 + i];
    most = numbers[9];
    period = reach = config.lease.main_every * n;
    base = (1000 / period + 1) * (int64_t)period;
    if (reach > MOST_WINDOW / 2 || period + n > 250) return 2;
    start();
    size = 5 + reach * (1 + config.lease.adoption + hands_on() * 3) + n * (1 + reach); /* at most */
    places_in_table = 2 * most + 7;
    states = malloc((size_t)most * (size_t)size);
    table = calloc((size_t)places_in_table, sizeof *table);
    if (size > MOST_BYTES || !states || !table) return 2;
    int closed;
    const long depth = search(&closed);
    if (broken) printf("broken %s; ", broken);
    printf("states %ld depth %ld steps %ld %s\n", known, depth, steps, closed ? "closed" : "open");
    return broken != NULL;
}
