// Informs ThreadSanitizer about synchronisation. It does not see how OpenMP's runtime, which is not built with it,
// hands work over. What a thread does before it releases an address precedes what others do after they acquire it.
#pragma once

#ifdef __SANITIZE_THREAD__
#include <sanitizer/tsan_interface.h>
#define EDGEGRAD_UNSEEN __attribute__((no_sanitize_thread))
#else
#define EDGEGRAD_UNSEEN
#define __tsan_acquire(address)
#define __tsan_release(address)
#endif
