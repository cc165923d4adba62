#include "rays/embree.h"

#ifdef _WIN32
#define NOMINMAX
#include <sub_cameras.h>
#else
#include <dlfcn.h>
#endif
#ifdef __linux__
#include <sys/prctl.h>
#endif

#include <chrono>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <new>
#include <stdexcept>
#include <system_error>
#include <thread>

#include "core/parallel.h"
#include "rays/embree_library.h"
#include "rays/raycast.h"

namespace edgegrad {

using namespace embree;

namespace embree {

Library rtc;

// Embree keeps one error per thread and device; asking clears it.
void throw_on_error(const char* doing) {
    const int error = rtc.rtcGetDeviceError(rtc.device);
    if (error == ERROR_OUT_OF_MEMORY) throw std::bad_alloc();
    if (error != ERROR_NONE)
        throw std::runtime_error(std::string("Embree failed while ") + doing + ", error " + std::to_string(error));
}

}  // namespace embree

namespace {

void* open_library(const std::string& path) {
#ifdef _WIN32
    return reinterpret_cast<void*>(LoadLibraryExA(path.c_str(), nullptr, LOAD_WITH_ALTERED_SEARCH_PATH));
#else
    return dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL);
#endif
}

void* symbol(void* library, const char* name) {
#ifdef _WIN32
    return reinterpret_cast<void*>(GetProcAddress(static_cast<HMODULE>(library), name));
#else
    return dlsym(library, name);
#endif
}

std::string open_error() {
#ifdef _WIN32
    return "error " + std::to_string(GetLastError());
#else
    const char* text = dlerror();
    return text ? text : "unknown error";
#endif
}

void open_device(const std::string& path, const std::string& options) {
    void* library = open_library(path);
    if (!library) throw std::runtime_error("cannot open " + path + ": " + open_error());
    Library found;
#define EDGEGRAD_LOAD(name, result, parameters)                                  \
    found.name = reinterpret_cast<result(*) parameters>(symbol(library, #name)); \
    if (!found.name) throw std::runtime_error(path + " lacks " #name "; version 4.x is needed");
    EDGEGRAD_EMBREE_FUNCTIONS(EDGEGRAD_LOAD)
#undef EDGEGRAD_LOAD
    found.device = found.rtcNewDevice(options.c_str());
    if (!found.device)
        throw std::runtime_error("Embree cannot make a device on this processor, error " +
                                 std::to_string(found.rtcGetDeviceError(nullptr)));
    found.version = int(found.rtcGetDeviceProperty(found.device, DEVICE_PROPERTY_VERSION));
    if (found.rtcGetDeviceProperty(found.device, DEVICE_PROPERTY_VERSION_MAJOR) != 4)
        throw std::runtime_error("expected Embree 4.x, got version " + std::to_string(found.version) + " in " + path);
    if (found.rtcGetDeviceProperty(found.device, DEVICE_PROPERTY_NATIVE_RAY16_SUPPORTED)) found.packet_width = 16;
    rtc = found;
}

}  // namespace

std::mutex embree_mutex;

namespace {

std::chrono::steady_clock::time_point last_build;  // embree_mutex guards it.

#if defined(__linux__)
constexpr char worker_name[] = "embree";

// Returns whether one of these threads runs, or waits for a processor.
bool a_worker_is_awake() {
    std::error_code error;
    for (const auto& task : std::filesystem::directory_iterator("/proc/self/task", error)) {
        std::string line;  // form: number (name) state …
        std::getline(std::ifstream(task.path() / "stat"), line);
        const size_t name = line.find('('), state = line.rfind(')') + 2;
        if (name == std::string::npos || state >= line.size()) continue;
        if (line.substr(name + 1, state - name - 3) == worker_name && line[state] != 'S') return true;
    }
    return false;
}
#else
bool a_worker_is_awake() { return false; }
#endif

}  // namespace

// Waits until Embree's threads sleep. A build ends with its work, while its helpers still take locks of TBB on their
// way out. A child forked just then would wait for these locks forever. Helpers look for more work for much less than a
// millisecond, but a busy machine may delay one. Linux tells their state. Elsewhere, and for threads that another user
// of TBB started, only waiting helps. Two checks are needed, because the last one awake may have woken one that was
// checked before.
void let_embree_sleep() {
    using std::chrono::milliseconds;
    std::this_thread::sleep_until(last_build + milliseconds(20));
    const auto give_up = std::chrono::steady_clock::now() + milliseconds(5000);
    for (int asleep = 0; asleep < 2 && std::chrono::steady_clock::now() < give_up; ++asleep)
        if (a_worker_is_awake()) asleep = -1, std::this_thread::sleep_for(milliseconds(1));
}

namespace embree {

void note_build() { last_build = std::chrono::steady_clock::now(); }

#if defined(__linux__)
// New threads inherit its name.
NamedWorkers::NamedWorkers() { prctl(PR_GET_NAME, own_), prctl(PR_SET_NAME, worker_name); }
NamedWorkers::~NamedWorkers() { prctl(PR_SET_NAME, own_); }
#else
NamedWorkers::NamedWorkers() = default;
NamedWorkers::~NamedWorkers() = default;
#endif

}  // namespace embree

void open_embree(const std::string& path, const std::string& options) {
    {
        const std::lock_guard lock(embree_mutex);
        if (rtc.device) return;
        open_device(path, options);
    }
    // The first scene starts Embree's threads, so the first render does not lose a millisecond.
    const int32_t face[3] = {0, 1, 2};
    const double verts[9] = {0, 0, 0, 1, 0, 0, 0, 1, 0};
    ThreadTeam team(1);
    RayCaster(face, 1, 3).update(verts, team);
}

int embree_version() { return rtc.version; }

int packet_width() { return rtc.packet_width; }

}  // namespace edgegrad
