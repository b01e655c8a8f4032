/* SOURCE compiled for processors of four numbers at once (WIDE), where compiler and system can. */
#if defined(__x86_64__) && !(defined(_WIN32) && !defined(__clang__))
#define WIDE
#ifdef __clang__
#pragma clang attribute push(__attribute__((target("avx2"))), apply_to = function)
#else
#pragma GCC target("avx2")
#endif
#include SOURCE
#ifdef __clang__
#pragma clang attribute pop
#endif
#endif
