/* Authentication: BLAKE2s (RFC 7693), keyed, with the person string "dtsa v1", cut to 4 bytes. */
#include <string.h>

#include "dtsa.h"

static const uint32_t IV[8] = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                               0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};

static const uint8_t SIGMA[10][16] = {
    {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15},
    {14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3},
    {11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4},
    {7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8},
    {9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13},
    {2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9},
    {12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11},
    {13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10},
    {6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5},
    {10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0},
};

enum { BLOCK = 64 };

static uint32_t rotate(uint32_t x, int by) { return x >> by | x << (32 - by); }

static uint32_t word(const uint8_t *at)
{
    return (uint32_t)at[0] | (uint32_t)at[1] << 8 | (uint32_t)at[2] << 16 | (uint32_t)at[3] << 24;
}

static void quarter(uint32_t *v, int a, int b, int c, int d, uint32_t x, uint32_t y)
{
    v[a] += v[b] + x;
    v[d] = rotate(v[d] ^ v[a], 16);
    v[c] += v[d];
    v[b] = rotate(v[b] ^ v[c], 12);
    v[a] += v[b] + y;
    v[d] = rotate(v[d] ^ v[a], 8);
    v[c] += v[d];
    v[b] = rotate(v[b] ^ v[c], 7);
}

static void compress(uint32_t h[8], const uint8_t *block, uint32_t count, int last)
{
    uint32_t v[16], m[16];
    for (int i = 0; i < 16; i++) m[i] = word(block + 4 * i);
    for (int i = 0; i < 8; i++) {
        v[i] = h[i];
        v[8 + i] = IV[i];
    }
    v[12] ^= count;
    if (last) v[14] = ~v[14];
    for (int round = 0; round < 10; round++)
        for (int i = 0; i < 8; i++) {
            const int a = i & 3, turn = i >> 2; /* columns, then diagonals */
            quarter(v, a, 4 + ((a + turn) & 3), 8 + ((a + 2 * turn) & 3), 12 + ((a + 3 * turn) & 3),
                    m[SIGMA[round][2 * i]], m[SIGMA[round][2 * i + 1]]);
        }
    for (int i = 0; i < 8; i++) h[i] ^= v[i] ^ v[8 + i];
}

void dtsa_tag(const uint8_t *key, int key_length, uint64_t session, uint64_t slot,
              const uint8_t *data, long length, uint8_t tag[DTSA_TAG_BYTES])
{
    static const uint8_t PERSON[8] = "dtsa v1";
    uint8_t block[BLOCK] = {0};
    uint32_t h[8], count = BLOCK;
    memcpy(h, IV, sizeof h);
    h[0] ^= 0x01010000u ^ (uint32_t)key_length << 8 ^ DTSA_TAG_BYTES;
    h[6] ^= word(PERSON);
    h[7] ^= word(PERSON + 4);
    memcpy(block, key, (size_t)key_length);
    compress(h, block, count, 0);
    memset(block, 0, sizeof block);
    for (int i = 0; i < 8; i++) {
        block[i] = (uint8_t)(session >> 8 * i);
        block[8 + i] = (uint8_t)(slot >> 8 * i);
    }
    int used = 16;
    for (long i = 0; i < length; i++) {
        if (used == BLOCK) {
            compress(h, block, count += BLOCK, 0);
            memset(block, 0, sizeof block);
            used = 0;
        }
        block[used++] = data[i];
    }
    compress(h, block, count + (uint32_t)used, 1);
    for (int i = 0; i < DTSA_TAG_BYTES; i++) tag[i] = (uint8_t)(h[0] >> 8 * i);
}

long dtsa_open(const uint8_t *key, int key_length, uint64_t session, int64_t slot, int late,
               const uint8_t *data, long length)
{
    const long frame = length - DTSA_TAG_BYTES;
    if (frame < 1) return 0;
    for (int64_t sent = slot; sent >= 0 && sent >= slot - late; sent--) {
        uint8_t tag[DTSA_TAG_BYTES], differs = 0;
        dtsa_tag(key, key_length, session, (uint64_t)sent, data, frame, tag);
        for (int i = 0; i < DTSA_TAG_BYTES; i++) differs |= (uint8_t)(tag[i] ^ data[frame + i]);
        if (!differs) return frame;
    }
    return 0;
}
