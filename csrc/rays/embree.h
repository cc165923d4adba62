// Opens Embree's library once, and tells its version and when its threads sleep.
#pragma once

#include <mutex>
#include <string>

namespace edgegrad {

// Opens libembree4 and makes the device, with Embree's options. Throws std::runtime_error if it is missing or not 4.x.
void open_embree(const std::string& path, const std::string& options = "");

// Making, building or freeing a ray structure holds this, so that fork() can wait (before_fork()).
extern std::mutex embree_mutex;

// Waits, with embree_mutex held, until Embree's threads sleep after the last build.
void let_embree_sleep();

// Returns the version of the opened library, as 40400 for 4.4.0.
int embree_version();

// Returns the rays in a packet: 16 where the processor's vectors are that wide (AVX-512), else 8.
int packet_width();

}  // namespace edgegrad
