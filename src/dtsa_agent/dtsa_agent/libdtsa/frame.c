/* The radio frame, byte by byte. Little-endian; layout in docs/reference/protocol.md.
 *
 *   0      version (high nibble), profile (low nibble)
 *   1-2    sender's id
 *   3      c_r
 *   4-7    slot in which the state was sampled
 *   8-13   position, 3 x 16 bits, in steps that the swarm agrees on (2 mm)
 *   14-18  velocity, 3 x 12 bits, 1 cm/s, 4 bits zero          (profile paper)
 *   14-22  velocity and intended velocity, 6 x 12 bits, 1 cm/s (profile paper with intent)
 *
 * Profile paper has 19 bytes, with intent 23. Profile extended begins with the same 23 bytes, but
 * for bytes 2 and 3: see frame_extended.c.
 */
#include <string.h>

#include "frame.h"

static const double VELOCITY_STEP = 0.01;
static const double EVEN =
    6755399441055744.0; /* 3 * 2^51: added, it rounds to whole numbers, half to even */

int64_t quantise(double value, double step, int bits)
{
    const double top = (double)((1LL << (bits - 1)) - 1);
    double q = value / step;
    if (q > top) q = top;
    if (q < -top - 1.0) q = -top - 1.0;
    return (int64_t)(q + EVEN - EVEN);
}

static int all_numbers(const double *x, int n)
{
    for (int i = 0; i < n; i++)
        if (x[i] != x[i]) return 0;
    return 1;
}

int frame_length(int profile)
{
    switch (profile) {
    case DTSA_PROFILE_PAPER:
        return 19;
    case DTSA_PROFILE_PAPER_INTENT:
        return 23;
    case DTSA_PROFILE_EXTENDED:
        return EXTENDED_LENGTH;
    default:
        return 0;
    }
}

static void put12(uint8_t *out, int index, int64_t value)
{
    const unsigned u = (unsigned)value & 0xfffu;
    uint8_t *p = out + index * 3 / 2;
    if (index & 1) {
        p[0] = (uint8_t)((p[0] & 0x0fu) | (u & 0xfu) << 4);
        p[1] = (uint8_t)(u >> 4);
    } else {
        p[0] = (uint8_t)u;
        p[1] = (uint8_t)(u >> 8);
    }
}

static double get12(const uint8_t *in, int index)
{
    const uint8_t *p = in + index * 3 / 2;
    const unsigned u = index & 1 ? (unsigned)p[0] >> 4 | (unsigned)p[1] << 4
                                 : (unsigned)p[0] | ((unsigned)p[1] & 0xfu) << 8;
    return (double)((int)(u ^ 0x800u) - 0x800) * VELOCITY_STEP;
}

int frame_encode(const dtsa_frame *f, double position_step, uint8_t *out)
{
    const int length = frame_length(f->profile), extended = f->profile == DTSA_PROFILE_EXTENDED;
    if (!length || f->sender < 1 || f->sender > 65535 || f->c_r < 0 || f->c_r > 255) return 0;
    if (extended && f->sender > DTSA_EXTENDED_AGENTS_MAX) return 0;
    if (!all_numbers(f->p, 3) || !all_numbers(f->v, 3) || !all_numbers(f->c, 3)) return 0;
    memset(out, 0, (size_t)length);
    out[0] = (uint8_t)(FRAME_VERSION << 4 | f->profile);
    out[1] = (uint8_t)f->sender;
    out[2] = (uint8_t)(f->sender >> 8);
    out[3] = (uint8_t)(extended ? f->c_r != 0 : f->c_r);
    for (int i = 0; i < 4; i++) out[4 + i] = (uint8_t)(f->slot >> 8 * i);
    for (int i = 0; i < 3; i++) {
        const int64_t q = quantise(f->p[i], position_step, 16);
        out[8 + 2 * i] = (uint8_t)q;
        out[9 + 2 * i] = (uint8_t)((uint64_t)q >> 8);
        put12(out + 14, i, quantise(f->v[i], VELOCITY_STEP, 12));
    }
    if (f->profile != DTSA_PROFILE_PAPER)
        for (int i = 0; i < 3; i++) put12(out + 14, 3 + i, quantise(f->c[i], VELOCITY_STEP, 12));
    return length;
}

int frame_decode(const uint8_t *data, long length, double position_step, dtsa_frame *f)
{
    if (length < 1) return FRAME_BAD_LENGTH;
    if (data[0] >> 4 != FRAME_VERSION) return FRAME_BAD_HEADER;
    f->profile = data[0] & 0xf;
    const int expected = frame_length(f->profile);
    if (!expected) return FRAME_BAD_HEADER;
    if (length != expected) return FRAME_BAD_LENGTH;
    const int extended = f->profile == DTSA_PROFILE_EXTENDED;
    f->sender = extended ? data[1] : data[1] | data[2] << 8;
    if (!f->sender || (extended && f->sender > DTSA_EXTENDED_AGENTS_MAX)) return FRAME_BAD_FIELD;
    f->c_r = extended ? data[3] & 1 : data[3];
    f->slot = 0;
    for (int i = 0; i < 4; i++) f->slot |= (uint32_t)data[4 + i] << 8 * i;
    for (int i = 0; i < 3; i++) {
        f->p[i] = (double)(int16_t)(data[8 + 2 * i] | data[9 + 2 * i] << 8) * position_step;
        f->v[i] = get12(data + 14, i);
        f->c[i] = f->profile != DTSA_PROFILE_PAPER ? get12(data + 14, 3 + i) : 0.0;
    }
    if (f->profile == DTSA_PROFILE_PAPER && data[18] >> 4) return FRAME_BAD_FIELD;
    return FRAME_OK;
}

frame_condition frame_condition_of(const uint8_t *data)
{
    const int extended = (data[0] & 0xf) == DTSA_PROFILE_EXTENDED;
    return (frame_condition){.leaves = extended && data[2] == FRAME_LEAVES,
                             .rests = extended ? !(data[3] & 1) : !data[3],
                             .on_probation = extended && data[3] >> 1 & 1};
}
