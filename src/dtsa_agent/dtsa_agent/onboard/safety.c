/* Whether an agent on board may steer its vehicle. */
#include "safety.h"

#include <string.h>

static const float OUTSIDE_S = 0.3f; /* an estimate may jump for a moment */

void safety_reset(safety *s) { memset(s, 0, sizeof *s); }

static int is_inside(const safety_settings *c, const safety_view *v)
{
    for (int i = 0; i < 3; i++)
        if (!(v->position[i] >= c->low[i] && v->position[i] <= c->high[i])) return 0;
    return 1;
}

/* Why it has to land, if it has to. */
static safety_reason urgent(safety *s, const safety_settings *c, const safety_view *v,
                            float elapsed)
{
    s->sagged_s = v->battery_v >= c->battery_v ? 0.0f : s->sagged_s + elapsed;
    s->outside_s = is_inside(c, v) ? 0.0f : s->outside_s + elapsed;
    if (v->ordered) return SAFETY_ORDERED;
    if (s->sagged_s > c->sag_s) return SAFETY_BATTERY;
    if (s->outside_s > OUTSIDE_S) return SAFETY_OUTSIDE;
    return SAFETY_WELL;
}

/* Why it has to hover, if it has to. */
static safety_reason doubt(const safety_settings *c, const safety_view *v)
{
    if (!(v->unheard_s >= 0.0f && v->unheard_s <= c->unheard_s)) return SAFETY_UNHEARD;
    if (!(v->oldest_s >= 0.0f && v->oldest_s <= c->news_s)) return SAFETY_OLD_NEWS;
    if (!(v->rests_s <= c->rests_s)) return SAFETY_OLD_NEWS;
    return v->newcomer ? SAFETY_NEWCOMER : SAFETY_WELL;
}

static void enter(safety *s, safety_mode mode, safety_reason reason)
{
    if (s->mode != mode) s->since_s = 0.0f;
    s->mode = mode;
    s->reason = reason;
}

safety_mode safety_step(safety *s, const safety_settings *c, const safety_view *v, float elapsed)
{
    const safety_reason why_land = urgent(s, c, v, elapsed), why_hover = doubt(c, v);
    s->since_s += elapsed;
    s->well_s = why_hover || why_land ? 0.0f : s->well_s + elapsed;
    if (!v->enabled) s->refused = 0;
    if (!v->enabled || v->ground || !v->can_fly || !v->in_air || s->refused) {
        const safety_reason reason = !v->enabled ? SAFETY_DISABLED
                                     : v->ground ? SAFETY_GROUND
                                                 : SAFETY_CANNOT_FLY;
        if (s->mode != SAFETY_OFF) s->refused = v->enabled;
        /* Refused, it goes on saying what has ended its steering. */
        enter(s, SAFETY_OFF, s->mode == SAFETY_OFF && s->refused ? s->reason : reason);
        return s->mode;
    }
    if (s->mode == SAFETY_LAND) return s->mode;
    if (s->mode == SAFETY_OFF) { /* no take-over of a vehicle that would have to land at once */
        if (!why_land && !why_hover && s->well_s >= c->well_s)
            enter(s, SAFETY_FLY, SAFETY_WELL);
        else
            s->reason = why_land ? why_land : why_hover ? why_hover : SAFETY_WELL;
        return s->mode;
    }
    if (why_land)
        enter(s, SAFETY_LAND, why_land);
    else if (s->mode == SAFETY_HOVER && s->since_s > c->land_s)
        enter(s, SAFETY_LAND, s->reason);
    else if (why_hover)
        enter(s, SAFETY_HOVER, why_hover);
    else if (s->mode == SAFETY_HOVER && s->well_s >= c->well_s)
        enter(s, SAFETY_FLY, SAFETY_WELL);
    return s->mode;
}
