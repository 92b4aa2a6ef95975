/* Board mps2-an386 (Cortex-M4F), for QEMU: reset, output by semihosting, and what calls cost.
 *
 * Run with -icount shift=5 an instruction takes 32 ns, and the processor's clock of 25 MHz ticks
 * every 40 ns: 5 ticks are 4 x 1.5625 instructions. Stack: painted before a call, looked at after
 * it. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include "meter.h"

extern uint32_t __stack, __data_start, __data_end, __data_load, __bss_start, __bss_end;
extern void initialise_monitor_handles(void);
int main(void);
void reset(void);

static void halt(void) { exit(2); }

__attribute__((section(".vectors"), used)) static void *const VECTORS[16] = {
    &__stack, reset, halt, halt, halt, halt, halt, 0, 0, 0, 0, halt, halt, 0, halt, halt,
};

static volatile uint32_t *const SYSTICK =
    (volatile uint32_t *)0xe000e010; /* control, reload, value */

void reset(void)
{
    *(volatile uint32_t *)0xe000ed88 |= 0xfu << 20; /* floating point on */
    for (uint32_t *to = &__data_start, *from = &__data_load; to < &__data_end;) *to++ = *from++;
    for (uint32_t *to = &__bss_start; to < &__bss_end;) *to++ = 0;
    SYSTICK[1] = 0xffffff;
    SYSTICK[2] = 0;
    SYSTICK[0] = 5;
    initialise_monitor_handles();
    exit(main());
}

#ifdef METERED
enum { PAINT = 0xa5a5a5a5, WORDS = 2048 };

static uint32_t most[METERS], calls[METERS], stack[METERS], begun, none;
static uint64_t sum[METERS];

static __attribute__((noinline)) uint32_t *here(void)
{
    uint32_t *sp;
    __asm volatile("mov %0, sp" : "=r"(sp));
    return sp;
}

void meter_reset(void)
{
    for (int i = 0; i < METERS; i++) most[i] = calls[i] = stack[i] = 0, sum[i] = 0;
    none = 0;
    meter_begin();
    none = (begun - SYSTICK[2]) & 0xffffff;
}

void __attribute__((noinline)) meter_begin(void)
{
    uint32_t *top = here();
    for (uint32_t *word = top - WORDS; word < top - 16; word++) *word = PAINT;
    begun = SYSTICK[2];
}

void __attribute__((noinline)) meter_end(int which)
{
    const uint32_t ticks = ((begun - SYSTICK[2]) & 0xffffff) - none;
    const uint32_t instructions = ticks * 5 / 4;
    uint32_t *top = here(), *word = top - WORDS;
    while (word < top && *word == PAINT) word++;
    const uint32_t used = (uint32_t)(top - word) * 4;
    if (instructions > most[which]) most[which] = instructions;
    if (used > stack[which]) stack[which] = used;
    sum[which] += instructions;
    calls[which]++;
}

void meter_print(void)
{
    for (int i = 0; i < METERS; i++)
        printf(" %lu %lu %lu", (unsigned long)(calls[i] ? sum[i] / calls[i] : 0),
               (unsigned long)most[i], (unsigned long)stack[i]);
    printf("\n");
}
#endif
