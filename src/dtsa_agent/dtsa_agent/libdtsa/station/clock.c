/* When slots begin. Every frame shows when its sender's slot 0 began: its origin. An agent has an
 * origin of its own, and moves it a little towards those that it hears (see align).
 *
 * Frames whose origin is off by more than the link is trusted with show another time. The sender may
 * be of another group, or the frame was under way for long; a frame is never early. Each agent counts
 * for the time of its last frame, and for another time only when two frames in a row have shown it.
 * An agent takes another time over
 *   - when most of all agents heard lately, itself included, are in it,
 *   - or half of them, and it is the earlier one; at once when no frame was ever heard in the own,
 *   - or after some patience: when no other agent is heard in the own one, or it is the earlier one and
 *     less than half of the swarm is heard in the own one. This ends what the first two rules leave open
 *     where agents do not all hear each other.
 * So the smaller group gives way, and of two equal ones the later. If the slots' numbers agree the
 * agent moves its slots and goes on; else it restarts, and knows nothing of the turns. */
#include "station.h"

/* By how much the own slots move for a frame that came later than expected: mostly not at all, else
 * by half the median of some frames. A median shrugs off single delays; and since all move towards all
 * others, the swarm agrees on a time that drifts with the mean of its clocks. */
static int64_t align(dtsa_station *s, int64_t offset)
{
    int at = s->offset_count++;
    for (; at > 0 && s->offsets[at - 1] > offset; at--) s->offsets[at] = s->offsets[at - 1];
    s->offsets[at] = offset;
    if (s->offset_count < RECEPTIONS) return 0;
    s->offset_count = 0;
    s->counts.alignments++;
    /* Rounded half away from zero, so that both directions weigh the same. */
    const int64_t median = s->offsets[RECEPTIONS / 2];
    return median < 0 ? -((1 - median) / 2) : (median + 1) / 2;
}

int64_t clock_slot(const dtsa_station *s, int64_t now)
{
    return floor_div(now - s->origin_ns, s->settings.slot_ns);
}

/* a modulo b, from -b / 2 to b / 2 */
static int64_t centred(int64_t a, int64_t b)
{
    const int64_t rest = a - floor_div(a, b) * b;
    return rest > b / 2 ? rest - b : rest;
}

int64_t clock_unwrap(const dtsa_station *s, uint32_t slot, int64_t now)
{
    const int64_t here = clock_slot(s, now);
    return here + centred((int64_t)slot - here, (int64_t)s->settings.slot_cycle);
}

int64_t clock_apart(const dtsa_station *s, int64_t a_ns, int64_t b_ns)
{
    return centred(a_ns - b_ns, (int64_t)s->settings.slot_cycle * s->settings.slot_ns);
}

static int is_same(const dtsa_station *s, int64_t a_ns, int64_t b_ns)
{
    const int64_t apart = clock_apart(s, a_ns, b_ns);
    return apart <= s->settings.link.trust_ns && apart >= -s->settings.link.trust_ns;
}

/* Agents heard lately in the own time, with itself. */
int clock_in_step(const dtsa_station *s, int64_t now)
{
    int heard = 1;
    for (int k = 0; k < s->settings.agents; k++)
        heard += contacts_is_recent(s, &s->peers[k], now) &&
                 is_same(s, s->peers[k].origin_ns, s->origin_ns);
    return heard;
}

static int gives_way(dtsa_station *s, int64_t origin_ns, int64_t now)
{
    const int earlier = clock_apart(s, origin_ns, s->origin_ns) < 0;
    int all = 1, here = 1, there = 0;
    for (int k = 0; k < s->settings.agents; k++) {
        const peer *p = &s->peers[k];
        if (!contacts_is_recent(s, p, now)) continue;
        all++;
        here += is_same(s, p->origin_ns, s->origin_ns);
        there += p->steady && is_same(s, p->origin_ns, origin_ns);
    }
    if (2 * there > all || (earlier && (s->state == DTSA_ALONE || 2 * there == all))) return 1;
    if (!there) return 0;
    if (now - s->in_step_ns > s->patience_ns) return 1;
    if (!earlier || 2 * here > s->settings.agents) return 0;
    if (s->earlier_ns == INT64_MIN || now - s->earlier_ns > s->patience_ns) s->earlier_since = now;
    s->earlier_ns = now;
    return now - s->earlier_since > s->patience_ns;
}

/* Whether slots agree, if their numbers count from there. */
static int is_near(const dtsa_station *s, int64_t origin_ns)
{
    const int64_t apart = clock_apart(s, origin_ns, s->origin_ns), half = s->settings.slot_ns / 2;
    return apart < half && apart > -half;
}

static void take_over(dtsa_station *s, int64_t origin_ns, int64_t now)
{
    s->offset_count = 0;
    s->origin_ns = origin_ns;
    for (int k = 0; k < s->settings.agents; k++)
        s->peers[k].near_ns = is_near(s, s->peers[k].origin_ns) ? s->peers[k].heard_ns : INT64_MIN;
    s->in_step_ns = now;
    s->earlier_ns = INT64_MIN;
    s->state = DTSA_JOINED;
}

int clock_hear(dtsa_station *s, int k, int64_t origin_ns, int64_t arrival_ns)
{
    peer *p = &s->peers[k];
    p->steady = p->heard_ns != INT64_MIN && is_same(s, p->origin_ns, origin_ns);
    p->heard_ns = arrival_ns;
    p->origin_ns = origin_ns;
    if (s->state == DTSA_LISTENING) {
        take_over(s, origin_ns, arrival_ns);
        return RESTARTED;
    }
    const int64_t apart = clock_apart(s, origin_ns, s->origin_ns);
    const int near = is_near(s, origin_ns);
    if (near) p->near_ns = arrival_ns;
    if (is_same(s, origin_ns, s->origin_ns)) {
        if (s->settings.keeps_time != DTSA_KEEPS_STARTS) s->origin_ns += align(s, apart);
        s->in_step_ns = arrival_ns;
        s->state = DTSA_JOINED;
        return IN_STEP;
    }
    if (s->settings.keeps_time) return IN_STEP;
    if (!gives_way(s, origin_ns, arrival_ns)) {
        if (near) return IN_STEP;
        if (p->steady)
            p->near_ns = INT64_MIN; /* it has gone to another time, and hears this agent no more */
        return OTHER;
    }
    take_over(s, near ? s->origin_ns + apart : origin_ns, arrival_ns);
    return near ? SHIFTED : RESTARTED;
}
