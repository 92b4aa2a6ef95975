/* How much longer frames are under way than the link says. No agent can tell alone, two together can.
 *
 * What agent i hears of j comes later than i expects by d + o_j - o_i, and what j hears of i by d +
 * o_i - o_j: d is the delay that the link does not know of, o the offsets of their slots. So d is
 * half the sum. Every datagram names some of the agents that its sender hears and how late, in turn;
 * an agent takes the median over all pairs that it is part of. Without it all would move
 * towards frames that seem late, and the slots of agents that hear many would run away from others'.
 *
 * What a peer has said of this agent is forgotten when it is old, or when the peer says that it does not
 * hear this agent any more: both move on, and an old sum would move this agent away for good. */
#include <string.h>

#include "station.h"

enum { SHARE = 64, STEP_NS = 1000000 };

static void forget_sum(dtsa_station *s, peer *p)
{
    int at = 0;
    if (!(p->known & KNOWS_SUM)) return;
    while (s->sums[at] < p->sum_ns) at++;
    memmove(s->sums + at, s->sums + at + 1, sizeof *s->sums * (size_t)(--s->sum_count - at));
    p->known &= (uint8_t)~KNOWS_SUM;
}

static void set_sum(dtsa_station *s, peer *p, int64_t sum)
{
    int at;
    forget_sum(s, p);
    p->known |= KNOWS_SUM;
    p->sum_ns = sum;
    for (at = s->sum_count++; at > 0 && s->sums[at - 1] > sum; at--) s->sums[at] = s->sums[at - 1];
    s->sums[at] = sum;
}

void delay_forget_report(dtsa_station *s, peer *p)
{
    forget_sum(s, p);
    p->known &= (uint8_t)~KNOWS_REPORT;
}

void delay_hear(dtsa_station *s, const dtsa_datagram *d, int64_t offset_ns, int64_t arrival)
{
    int64_t target = 0; /* without a pair the link is believed */
    const int64_t limit = s->settings.slot_ns / 4;
    peer *p = &s->peers[d->sender - 1];
    p->offset_ns = limited(offset_ns, limit);
    p->known |= KNOWS_OFFSET;
    for (int i = 0; i < s->settings.link.names; i++) {
        if (d->names[i].id != s->settings.id) continue;
        p->report_ns = limited(d->names[i].late_ns, limit);
        p->reported_ns = arrival;
        p->known |= KNOWS_REPORT;
    }
    if (p->known & KNOWS_REPORT && arrival - p->reported_ns > s->resting_ns)
        delay_forget_report(s, p);
    if (p->known & KNOWS_REPORT) set_sum(s, p, p->offset_ns + p->report_ns);
    if (s->sum_count)
        target = floor_div(s->sums[s->sum_count / 2] + s->sums[(s->sum_count - 1) / 2], 4);
    s->flight_error_ns += floor_div(limited(target - s->flight_error_ns, STEP_NS), SHARE);
}

/* The own slots begin later by so much. */
void delay_shift(dtsa_station *s, int64_t by_ns)
{
    for (int k = 0; by_ns && k < s->settings.agents; k++) {
        if (s->peers[k].known & KNOWS_OFFSET) s->peers[k].offset_ns -= by_ns;
        if (s->peers[k].known & KNOWS_REPORT) s->peers[k].report_ns += by_ns;
    }
}

void delay_reset(dtsa_station *s)
{
    for (int k = 0; k < s->settings.agents; k++) s->peers[k].known = 0;
    s->sum_count = 0;
}

static int is_named(const dtsa_station *s, int k, int64_t now)
{
    return s->peers[k].known & KNOWS_OFFSET && contacts_hears(s, &s->peers[k], now);
}

/* Whom the next datagram names: the heard agents in turn, in the order of ids, the last one again, so
 * that an agent that is missing between two neighbours is known not to be heard. */
void delay_name(dtsa_station *s, int64_t now, dtsa_named out[DTSA_NAMES_MAX])
{
    int heard = 0, index = 0;
    for (int k = 0; k < s->settings.agents; k++) heard += is_named(s, k, now);
    const int count = heard < s->settings.link.names ? heard : s->settings.link.names;
    for (int k = 0; k < s->settings.agents && count; k++) {
        if (!is_named(s, k, now)) continue;
        const int place = (index++ - s->name_turn % heard + heard) % heard;
        if (place < count) out[place] = (dtsa_named){k + 1, s->peers[k].offset_ns};
    }
    if (heard) s->name_turn = (s->name_turn % heard + (count > 1 ? count - 1 : count)) % heard;
}
