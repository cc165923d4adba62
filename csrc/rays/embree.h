// Embree's library: opened once, its version, and when its threads sleep.
#pragma once

#include <mutex>
#include <string>

namespace edgegrad {

// Opens libembree4 and makes the device, with options of Embree's own. Throws std::runtime_error when it is not there
// or not version 4.
void open_embree(const std::string& path, const std::string& options = "");

// Held by whoever makes, builds or frees a ray structure, so that fork() can wait until nobody does: see before_fork().
extern std::mutex embree_mutex;

// Waits, with embree_mutex held, until Embree's threads sleep after the last build.
void let_embree_sleep();

// Version of the opened library, as 40400 for 4.4.0.
int embree_version();

// Rays in a packet: 16 where the processor's vectors are that wide (AVX-512), else 8.
int packet_width();

}  // namespace edgegrad
