#ifndef DEA_KERNEL_VERSION_H
#define DEA_KERNEL_VERSION_H

#include <stdint.h>

/* Raise it, and VERSION in library.py, whenever a function of the kernel takes or gives something else than before. */
#define DEA_KERNEL_VERSION 4

int64_t dea_kernel_version(void);
const char *dea_kernel_sources(void);
const char *dea_kernel_compiler(void);

#endif
