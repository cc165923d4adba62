#include "core/openmp_runtime.h"

#include <omp.h>

#ifndef _WIN32
#include <dlfcn.h>
#endif

namespace edgegrad {

void end_waiting_threads() {
#ifdef __linux__
    // It is looked up by name, for torch may bring a runtime that does not have it.
    constexpr int omp_pause_hard = 2;
    if (void* pause = dlsym(RTLD_DEFAULT, "omp_pause_resource_all"))
        reinterpret_cast<int (*)(int)>(pause)(omp_pause_hard);
#endif
}

std::string openmp_runtime() {
#ifdef _WIN32
    return "vcomp140.dll";
#else
    Dl_info info;
    return dladdr(reinterpret_cast<void*>(&omp_get_thread_num), &info) && info.dli_fname ? info.dli_fname : "";
#endif
}

}  // namespace edgegrad
