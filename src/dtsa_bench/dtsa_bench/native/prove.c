/* Explores policy lease state by state: libdtsa's own code, with every choice of the world tried in every slot.
 *
 * A state is what the agents remember (slot numbers relative to now and cut off where nothing looks at them any more), and
 * a ledger of what was given away in frames. In a slot each agent may have something to say or not, may give all of its
 * turns away or none, may take an OPEN turn or not, believes that many wake or not; each receiver hears any one of those
 * that send, or nothing; restarts, deaths and returns happen as often as the budgets say. Draws are choices: draw.c is left
 * out. Breadth first, states compared byte by byte, until there are no new ones.
 *
 *     prove AGENTS M S ADOPTION PATIENCE RESTARTS DEATHS RETURNS MOST_STATES
 *
 * prints one line of words and numbers, or the rule that is broken and how it came about; exit code 1 then.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "policy/lease/lease.h"

enum { MOST_AGENTS = 3, MOST_WINDOW = 64, MOST_BYTES = 512, MOST_CHOICES = 64 };

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

uint64_t mix64(uint64_t x) { return x; } /* digests of tables do not count */

double draw_uniform(uint64_t key, uint64_t what)
{
    (void)key;
    (void)what;
    return choose(2) ? 1.0 : 0.0;
}

/* ---- the world ---- */

typedef struct ledger {
    uint8_t owner;  /* what its owner gave the turn away as */
    uint8_t others; /* bit k: an adopter gave it to agent k */
} ledger;

static dtsa_config config;
static dtsa_agent *agents[MOST_AGENTS];
static int n, window, period, restarts, deaths, returns;
static int64_t slot, base, reach; /* reach: ages beyond it are one */
static int left[3];               /* restarts, deaths, returns still to come */
static ledger book[MOST_WINDOW];  /* of turn t: book[t % MOST_WINDOW] */
static const char *broken;

static void start(void)
{
    static double places[6 * MOST_AGENTS];
    config.agents = n;
    config.slot_s = 0.01;
    config.steps = config.c_r = config.gossip = 1;
    config.policy = DTSA_POLICY_LEASE;
    config.estimator = DTSA_ESTIMATE_LINEAR;
    config.avoider = DTSA_AVOID_NONE;
    config.profile = DTSA_PROFILE_EXTENDED;
    config.r_min = 0.3;
    config.position_step = 0.002;
    config.lease.share = 1.0;
    config.start = places;
    config.target = places + 3 * n;
    const size_t bytes = dtsa_agent_bytes(&config);
    for (int k = 0; k < n; k++) agents[k] = dtsa_agent_start(malloc(bytes), bytes, &config, k + 1);
    left[0] = restarts;
    left[1] = deaths;
    left[2] = returns;
}

static int anchor(int64_t turn) { return (turn / n + turn % n) % config.lease.anchor_every == 0; }

/* ---- states as bytes ---- */

static uint8_t *at;

static void put(int64_t value) { *at++ = (uint8_t)value; }

static int64_t clip(int64_t age) { return age < reach ? age : reach; }

/* 0: never (-1), 1: gone (any other negative), else 2 + age */
static void put_time(int64_t time) { put(time == -1 ? 0 : time < 0 ? 1 : 2 + clip(slot - time)); }

static int pack(uint8_t *out)
{
    at = out;
    put(slot < n ? slot : n + slot % period);
    for (int i = 0; i < 3; i++) put(left[i]);
    for (int64_t t = slot; t < slot + window; t++) {
        put(book[t % MOST_WINDOW].owner);
        if (config.lease.adoption) put(book[t % MOST_WINDOW].others);
    }
    for (int k = 0; k < n; k++) {
        const lease_scope v = lease_of(agents[k]);
        const lease_agent *a = v.a;
        put(agents[k]->present | a->started << 2 | a->probation << 3 | a->anchored << 4 |
            (a->idle_since >= 0) << 5 | a->leaving << 6);
        if (!a->started) continue;
        put_time(a->woke);
        put_time(a->claimed);
        put_time(a->born);
        put(a->deaf);
        for (int64_t t = slot - 1; t < slot - 1 + window; t++)
            put(v.lessee[(t + window) % v.window]);
        for (int i = 0; i < n; i++) {
            put_time(v.heard[i]);
            put_time(agents[k]->table->sent_slot[i]);
            put(v.miss[i] | v.quiet[i] << 4 | agents[k]->table->in_ap[i] << 5);
        }
    }
    return (int)(at - out);
}

static int64_t take(void) { return *at++; }

static int64_t take_time(int64_t gone)
{
    const int64_t value = take();
    return value == 0 ? -1 : value == 1 ? gone : slot - (value - 2);
}

static void unpack(const uint8_t *in)
{
    at = (uint8_t *)(uintptr_t)in;
    slot = take();
    if (slot >= n) slot = base + (slot - n);
    for (int i = 0; i < 3; i++) left[i] = (int)take();
    memset(book, 0, sizeof book);
    for (int64_t t = slot; t < slot + window; t++) {
        book[t % MOST_WINDOW].owner = (uint8_t)take();
        if (config.lease.adoption) book[t % MOST_WINDOW].others = (uint8_t)take();
    }
    for (int k = 0; k < n; k++) {
        agent_forget(agents[k]);
        lease_scope v = lease_of(agents[k]);
        lease_agent *a = v.a;
        const int flags = (int)take();
        agents[k]->present = flags & 3;
        agents[k]->frame_length = 0;
        if (!(flags & 4)) continue;
        a->started = 1;
        a->probation = flags >> 3 & 1;
        a->anchored = flags >> 4 & 1;
        a->leaving = flags >> 6 & 1;
        a->idle_since = flags >> 5 & 1 ? slot - 1 : -1;
        a->woke = take_time(-1);
        a->claimed = take_time(-1);
        a->born = take_time(-1);
        a->deaf = (int32_t)take();
        a->now = slot - 1;
        for (int64_t t = slot - 1; t < slot - 1 + window; t++)
            v.lessee[(t + window) % v.window] = (uint8_t)take();
        for (int i = 0; i < n; i++) {
            v.heard[i] = take_time(INT64_MIN / 4);
            agents[k]->table->sent_slot[i] = take_time(-1);
            const int bits = (int)take();
            v.miss[i] = bits & 15;
            v.quiet[i] = bits >> 4 & 1;
            agents[k]->table->in_ap[i] = bits >> 5 & 1;
        }
    }
}

/* ---- rules (docs/protocol.md, invariants) ---- */

static void rule(int holds, const char *name)
{
    if (!holds && !broken) broken = name;
}

/* What a frame gives away, read without the agents' own code for it. */
static void write_down(int sender, const uint8_t *data)
{
    extended_frame e;
    rule(extended_decode(data, EXTENDED_LENGTH, config.position_step, &e) == FRAME_OK, "frame");
    if (broken || !e.lease_count) return;
    rule(slot % n == sender, "2: gives away in an own turn only");
    rule(config.lease.adoption || !e.c_s, "2: adopts where there is no adoption");
    int place = 0, own = 1;
    for (int j = 1; j <= config.lease.anchor_every; j++)
        for (int i = e.c_s; i >= 0; i--) {
            const int64_t turn = slot + (int64_t)j * n - i;
            ledger *entry = &book[turn % MOST_WINDOW];
            if (anchor(turn) && !i) own = 0;
            if (anchor(turn) || (!i && !own)) continue;
            const int given = place < e.lease_count ? e.leases[place++] : 0;
            if (!given) continue;
            if (i)
                entry->others |= (uint8_t)(1 << (given - 1));
            else
                rule(!entry->owner || entry->owner == given, "3: gives a turn away once");
            if (!i) entry->owner = (uint8_t)given;
        }
    rule(place >= e.lease_count || !e.leases[place], "4: gives no anchor away, nothing beyond it");
}

static void judge(int sender, int probation, int64_t woke)
{
    const ledger *entry = &book[slot % MOST_WINDOW];
    const int owner = slot % n == sender, lent = entry->others >> sender & 1;
    if (entry->owner == LEASE_OPEN) rule(woke >= 0, "2: only who wakes takes OPEN turns");
    rule(entry->owner != LEASE_OPEN || config.lease.open_every, "2: OPEN where there is none");
    if (owner)
        rule(!entry->owner || entry->owner == sender + 1 || lent || entry->owner == LEASE_OPEN,
             "3: does not send in a turn that it gave away");
    else
        rule(entry->owner == sender + 1 || entry->owner == LEASE_OPEN || lent,
             "2: owner, lessee or waker");
    if (probation)
        rule((owner && anchor(slot)) || entry->owner == LEASE_OPEN, "8: probation: anchors only");
}

/* ---- one slot ---- */

static void happen(int k)
{
    lease_scope v = lease_of(agents[k]);
    if (!agents[k]->present) {
        if (left[2] && choose(2)) {
            left[2]--;
            agents[k]->present = 1;
        }
        return;
    }
    if (left[0] && v.a->started && choose(2)) {
        left[0]--;
        agent_forget(agents[k]);
    } else if (left[1] && choose(2)) {
        left[1]--;
        agents[k]->present = 0;
        agent_forget(agents[k]);
        return;
    }
    agents[k]->goal[0] = choose(2) ? 5.0 : 0.0; /* something to say */
}

static void hear(int k, const int *senders, int count, uint8_t frames[][DTSA_FRAME_MAX])
{
    const int heard = choose(count + 1);
    if (!heard) return;
    const int sender = senders[heard - 1];
    const uint8_t *data = frames[sender];
    const int c_s = data[2], claimed = c_s != 255 && (sender - k + n) % n <= c_s;
    dtsa_agent_hear(agents[k], slot, data, EXTENDED_LENGTH);
    const lease_scope v = lease_of(agents[k]);
    if (config.lease.adoption && claimed && v.a->started)
        rule(v.a->probation, "8: who hears itself claimed is in probation");
}

static void step(void)
{
    uint8_t frames[MOST_AGENTS][DTSA_FRAME_MAX];
    int senders[MOST_AGENTS], count = 0;
    for (int k = 0; k < n; k++) happen(k);
    for (int k = 0; k < n; k++) {
        dtsa_agent *a = agents[k];
        a->frame_length = 0;
        a->decision.sends = 0;
        if (!a->present) continue;
        lease_scope v = lease_of(a);
        const int64_t woke = v.a->woke;
        agent_decide(a, slot);
        v.a->wakers = 0.0;
        v.a->attempts = 0;
        if (!a->decision.sends) continue;
        judge(k, v.a->probation, v.a->woke >= 0 ? v.a->woke : woke);
        if (slot % n == k) {
            a->final = (uint8_t)choose(2);
            if (config.lease.open_every > 1) v.a->wakers = choose(2);
        }
        a->frame_length = (uint8_t)agent_speak(a, slot, a->frame);
        v.a->wakers = 0.0;
        memcpy(frames[k], a->frame, DTSA_FRAME_MAX);
        senders[count++] = k;
        write_down(k, frames[k]);
    }
    const ledger *entry = &book[slot % MOST_WINDOW];
    rule(count < 2 || entry->owner == LEASE_OPEN || entry->others, "1: at most one sends");
    for (int k = 0; k < n && count; k++)
        if (agents[k]->present && !agents[k]->decision.sends) hear(k, senders, count, frames);
    for (int k = 0; k < n; k++) {
        dtsa_agent_end(agents[k], slot);
        lease_of(agents[k]).a->wakers = 0.0;
    }
    book[slot % MOST_WINDOW] = (ledger){0, 0};
    slot++;
}

/* ---- the search ---- */

static uint8_t *states;   /* one after the other, `size` bytes each */
static uint32_t *table;   /* index of a state + 1 by hash */
static uint32_t *parents; /* from which state */
static long known, most, places_in_table;
static int size;

static int is_new(const uint8_t *state, uint32_t parent)
{
    uint64_t hash = 14695981039346656037ULL;
    for (int i = 0; i < size; i++) hash = (hash ^ state[i]) * 1099511628211ULL;
    hash ^= hash >> 29;
    for (long place = (long)(hash % (uint64_t)places_in_table);;
         place = (place + 1) % places_in_table) {
        if (!table[place]) {
            table[place] = (uint32_t)known + 1;
            parents[known] = parent;
            memcpy(states + known++ * size, state, (size_t)size);
            return 1;
        }
        if (!memcmp(states + (long)(table[place] - 1) * size, state, (size_t)size)) return 0;
    }
}

static long slots_from_start(long state)
{
    long length = 0;
    for (; state; state = parents[state]) length++;
    return length;
}

int main(int argc, char **argv)
{
    long numbers[9];
    if (argc != 10) return 2;
    for (int i = 0; i < 9; i++) numbers[i] = strtol(argv[i + 1], NULL, 10);
    n = (int)numbers[0];
    config.lease = (dtsa_lease_config){(int)numbers[1], (int)numbers[2], (int)numbers[3], 0.0, 1.0,
                                       numbers[4]};
    restarts = (int)numbers[5];
    deaths = (int)numbers[6];
    returns = (int)numbers[7];
    most = numbers[8];
    const int every = config.lease.anchor_every, open = config.lease.open_every;
    window = (every + 2) * n;
    period = n * every * (open ? open : 1);
    const int64_t quiet = 2 * (int64_t)n * every;
    reach = numbers[4] > quiet ? numbers[4] + 1 : quiet + 1;
    base = (1000 / period + 1) * (int64_t)period;
    if (n < 2 || n > MOST_AGENTS || window > MOST_WINDOW || reach > 120 || period + n > 250)
        return 2;
    start();
    uint8_t state[MOST_BYTES] = {0};
    /* the largest state: all have started */
    size = 4 + window * (config.lease.adoption ? 2 : 1) + n * (5 + window + 3 * n);
    places_in_table = 2 * most + 7;
    states = malloc((size_t)most * (size_t)size);
    parents = malloc(sizeof *parents * (size_t)most);
    table = calloc((size_t)places_in_table, sizeof *table);
    if (size > MOST_BYTES || !states || !parents || !table) return 2;
    pack(state);
    is_new(state, 0);
    long steps = 0, depth = 0, level_end = 1;
    for (long i = 0; i < known; i++) {
        if (i == level_end) {
            depth++;
            level_end = known;
        }
        memset(chosen, 0, sizeof chosen);
        do {
            used = 0;
            unpack(states + i * size);
            step();
            steps++;
            if (broken) {
                printf("broken %s; states %ld depth %ld\n", broken, known, slots_from_start(i));
                return 1;
            }
            memset(state, 0, sizeof state);
            pack(state);
            if (known == most) {
                printf("states %ld depth %ld steps %ld open\n", known, depth, steps);
                return 0;
            }
            is_new(state, (uint32_t)i);
        } while (wind());
    }
    printf("states %ld depth %ld steps %ld closed\n", known, depth, steps);
    return 0;
}
