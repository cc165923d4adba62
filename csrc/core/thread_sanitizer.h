// What ThreadSanitizer is told: it does not see how OpenMP's runtime, which is not built with it, hands work over. What
// one thread did before it released an address comes before what another one does after it acquired that.
#pragma once

#ifdef __SANITIZE_THREAD__
#include <sanitizer/tsan_interface.h>
#define EDGEGRAD_UNSEEN __attribute__((no_sanitize_thread))
#else
#define EDGEGRAD_UNSEEN
#define __tsan_acquire(address)
#define __tsan_release(address)
#endif
