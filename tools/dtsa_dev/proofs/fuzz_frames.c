/* Fuzzed: decoders. A frame that is decoded is encoded again and means the same. */
#include <stdlib.h>
#include <string.h>

#include "frame.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void check(int holds)
{
    if (!holds) abort();
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    const double step = 0.002;
    dtsa_frame f;
    uint8_t out[DTSA_FRAME_MAX];
    if (frame_decode(data, (long)size, step, &f) == FRAME_OK &&
        f.profile != DTSA_PROFILE_EXTENDED) {
        check(frame_encode(&f, step, out) == (int)size);
        check(!memcmp(out, data, size));
    }
    extended_frame e, again;
    memset(&e, 0, sizeof e);
    memset(&again, 0, sizeof again);
    if (extended_decode(data, (long)size, step, &e) != FRAME_OK) return 0;
    if (!extended_encode(&e, step, out)) return 0; /* leases of three sections leave no room */
    check(extended_decode(out, sizeof out > EXTENDED_LENGTH ? EXTENDED_LENGTH : 0, step, &again) ==
          FRAME_OK);
    check(again.own.sender == e.own.sender && again.c_s == e.c_s && again.leaving == e.leaving);
    check(again.lease_count == e.lease_count && again.gossip_count == e.gossip_count);
    check(again.far_id == e.far_id && !memcmp(again.far_mask, e.far_mask, FAR_BYTES));
    check(again.relay_mask == e.relay_mask &&
          !memcmp(again.leases, e.leases, (size_t)e.lease_count));
    return 0;
}
