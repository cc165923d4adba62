// Controls the process's one OpenMP runtime, which is torch's.
#pragma once

#include <string>

namespace edgegrad {

// Ends the threads that wait for this thread's next parallel region, before fork(). The child lacks these threads, and
// GNU's runtime would wait for them forever. The next region starts new ones.
void end_waiting_threads();

// Returns the runtime's file.
std::string openmp_runtime();

}  // namespace edgegrad
