// Gives the opened library to the sources of this folder alone.
#pragma once

#include "rays/embree_api.h"

namespace edgegrad::embree {

struct Library {
#define EDGEGRAD_DECLARE(name, result, parameters) result(*name) parameters = nullptr;
    EDGEGRAD_EMBREE_FUNCTIONS(EDGEGRAD_DECLARE)
#undef EDGEGRAD_DECLARE
    Device device = nullptr;
    int version = 0;
    int packet_width = 8;
};
extern Library rtc;

// Throws the error of this thread since the last call, if any.
void throw_on_error(const char* doing);

// While it lives, threads that this one starts count as Embree's: see let_embree_sleep().
class NamedWorkers {
   public:
    NamedWorkers();
    ~NamedWorkers();

   private:
    [[maybe_unused]] char own_[16] = {};
};

// Records a build, with embree_mutex held.
void note_build();

}  // namespace edgegrad::embree
