/* Start of a program on an MPS2 board (Cortex-M4F: AN386, Cortex-M7: AN500) under QEMU, with semihosting. */
#include <stdint.h>
#include <stdlib.h>

extern uint32_t data_from, data_start, data_end, bss_start, bss_end, stack_top;
extern void initialise_monitor_handles(void);
extern int main(void);

static void start(void)
{
    uint32_t *from = &data_from;
    /* The floating point unit. */
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20;
    __asm volatile("dsb\n isb");
    for (uint32_t *to = &data_start; to < &data_end;) {
        *to++ = *from++;
    }
    for (uint32_t *to = &bss_start; to < &bss_end;) {
        *to++ = 0;
    }
    initialise_monitor_handles();
    exit(main());
}

static void fault(void)
{
    _Exit(3);
}

__attribute__((section(".vectors"), used)) static const void *const vectors[] = {
    &stack_top, (void *)start, (void *)fault, (void *)fault, (void *)fault, (void *)fault, (void *)fault,
};
