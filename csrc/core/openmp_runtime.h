// The process's one OpenMP runtime, which is torch's.
#pragma once

#include <string>

namespace edgegrad {

// Ends the threads that wait for this thread's next parallel region. To be called before fork(): in the child GNU's
// runtime would wait for these threads for ever, which are not there. The next region starts new ones.
void end_waiting_threads();

// Returns the runtime's file.
std::string openmp_runtime();

}  // namespace edgegrad
