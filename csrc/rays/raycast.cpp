#include "rays/raycast.h"

#ifdef _WIN32
#define NOMINMAX
#include <windows.h>
#else
#include <dlfcn.h>
#endif
#ifdef __linux__
#include <sys/prctl.h>
#endif

#include <algorithm>
#include <bit>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <future>
#include <limits>
#include <new>
#include <numeric>
#include <stdexcept>
#include <thread>

#include "core/array.h"
#include "rays/embree_api.h"

namespace edgegrad {

using namespace embree;

namespace {

struct Library {
#define EDGEGRAD_DECLARE(name, result, parameters) result(*name) parameters = nullptr;
    EDGEGRAD_EMBREE_FUNCTIONS(EDGEGRAD_DECLARE)
#undef EDGEGRAD_DECLARE
    Device device = nullptr;
    int version = 0;
    int packet_width = 8;
} rtc;

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

// Embree keeps one error a thread and device; asking clears it.
void throw_on_error(const char* doing) {
    const int error = rtc.rtcGetDeviceError(rtc.device);
    if (error == ERROR_OUT_OF_MEMORY) throw std::bad_alloc();
    if (error != ERROR_NONE)
        throw std::runtime_error(std::string("Embree failed while ") + doing + ", error " + std::to_string(error));
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

std::chrono::steady_clock::time_point last_build;  // guarded by embree_mutex

#if defined(__linux__)
constexpr char worker_name[] = "embree";

// While it lives, threads that this one starts have a name by which they are known: they inherit it.
class NamedWorkers {
   public:
    NamedWorkers() { prctl(PR_GET_NAME, own_), prctl(PR_SET_NAME, worker_name); }
    ~NamedWorkers() { prctl(PR_SET_NAME, own_); }

   private:
    char own_[16] = {};
};

// Whether one of these threads runs, or waits for a processor.
bool a_worker_is_awake() {
    std::error_code error;
    for (const auto& task : std::filesystem::directory_iterator("/proc/self/task", error)) {
        std::string line;  // number (name) state …
        std::getline(std::ifstream(task.path() / "stat"), line);
        const size_t name = line.find('('), state = line.rfind(')') + 2;
        if (name == std::string::npos || state >= line.size()) continue;
        if (line.substr(name + 1, state - name - 3) == worker_name && line[state] != 'S') return true;
    }
    return false;
}
#else
struct NamedWorkers {};
bool a_worker_is_awake() { return false; }
#endif

}  // namespace

// A build is over when its work is done, not when the threads that helped have gone: on their way they take locks of
// TBB, and a child that is forked just then would wait for these for ever. They look for more work for much less than a
// millisecond, but a busy machine may keep one from running for long. Linux tells; elsewhere, and for threads that
// another user of TBB started, all one can do is wait a while. Twice asleep, for the last one awake may have woken one
// that was looked at before.
void let_embree_sleep() {
    using std::chrono::milliseconds;
    std::this_thread::sleep_until(last_build + milliseconds(20));
    const auto give_up = std::chrono::steady_clock::now() + milliseconds(5000);
    for (int asleep = 0; asleep < 2 && std::chrono::steady_clock::now() < give_up; ++asleep)
        if (a_worker_is_awake()) asleep = -1, std::this_thread::sleep_for(milliseconds(1));
}

void open_embree(const std::string& path, const std::string& options) {
    {
        const std::lock_guard lock(embree_mutex);
        if (rtc.device) return;
        open_device(path, options);
    }
    // The first scene starts Embree's threads: a millisecond that would be missed in the first render.
    const int32_t face[3] = {0, 1, 2};
    const double verts[9] = {0, 0, 0, 1, 0, 0, 0, 1, 0};
    Team team(1);
    RayCaster(face, 1, 3).update(verts, team);
}

int embree_version() { return rtc.version; }

int packet_width() { return rtc.packet_width; }

RayCaster::RayCaster(const int32_t* faces, int64_t n_faces, int64_t n_verts)
    : faces_(faces),
      n_faces_(n_faces),
      n_verts_(n_verts),
      used_(n_verts, 0),
      positions_(3 * size_t(n_verts) + 1, 0.f) {  // Embree reads 16 bytes a vertex
    for (int64_t i = 0; i < 3 * n_faces; ++i) used_[faces[i]] = 1;
    if (std::find(used_.begin(), used_.end(), 0) == used_.end()) used_ = {};
    const std::lock_guard lock(embree_mutex);
    if (!rtc.device) throw std::runtime_error("Embree is not open");
    Geometry geometry = rtc.rtcNewGeometry(rtc.device, GEOMETRY_TYPE_TRIANGLE);
    rtc.rtcSetSharedGeometryBuffer(geometry, BUFFER_TYPE_INDEX, 0, FORMAT_UINT3, faces, 0, 12, n_faces);
    rtc.rtcSetSharedGeometryBuffer(geometry, BUFFER_TYPE_VERTEX, 0, FORMAT_FLOAT3, positions_.data(), 0, 12, n_verts);
    rtc.rtcSetGeometryEnableFilterFunctionFromArguments(geometry, true);
    Scene scene = rtc.rtcNewScene(rtc.device);
    geometry_ = geometry, scene_ = scene;
    // Low quality and dynamic at every build: fast, and which of two faces at the same depth wins does then not depend
    // on what was rendered before.
    rtc.rtcSetGeometryBuildQuality(geometry, BUILD_QUALITY_LOW);
    rtc.rtcSetSceneBuildQuality(scene, BUILD_QUALITY_LOW);
    rtc.rtcSetSceneFlags(scene, SCENE_FLAG_DYNAMIC | SCENE_FLAG_ROBUST | SCENE_FLAG_FILTER_FUNCTION_IN_ARGUMENTS);
    rtc.rtcAttachGeometry(scene, geometry);
    rtc.rtcSetSceneProgressMonitorFunction(
        scene, [](void* stop, double) { return !static_cast<const std::atomic<bool>*>(stop)->load(); }, &stop_);
    throw_on_error("making a scene");
}

RayCaster::~RayCaster() {
    const std::lock_guard lock(embree_mutex);
    rtc.rtcReleaseGeometry(static_cast<Geometry>(geometry_));
    rtc.rtcReleaseScene(static_cast<Scene>(scene_));
}

// The frame in which Embree sees the scene.
//
// Its origin is where the detail is: the mean of the faces' centroids weighted with 1 / (longest side)². Floats are as
// fine as their distance to the origin is short, so a small object on a wide ground plane keeps its shape.
//
// Its unit matters only where the scene spans many powers of ten, for floats round alike at any scale: but Embree takes
// products of three lengths, which must not leave the range of floats, 1e-38 … 1e38. So where the farthest vertex lies
// very many times the size of a face away, that size (its geometric mean) lies as far below the unit as that vertex
// lies above it.
void RayCaster::set_frame(const double* verts, Team& team) {
    const auto vertex = [&](int64_t v) { return Vec3{verts[3 * v], verts[3 * v + 1], verts[3 * v + 2]}; };
    const Vec3 base = vertex(faces_[0]);
    struct Block {
        Vec3 sum;
        double weight = 0;
        int64_t faces = 0, powers = 0;  // those that have a side; log₂ of its square, summed
    };
    const auto of_faces = team.of_blocks(n_faces_, [&](int64_t first, int64_t last) {
        Block block;
        for (int64_t f = first; f < last; ++f) {
            if (constexpr int ahead = 16; f + ahead < last)
                for (int i = 0; i < 3; ++i) prefetch(verts + 3 * int64_t(faces_[3 * (f + ahead) + i]));
            const Vec3 a = vertex(faces_[3 * f]), b = vertex(faces_[3 * f + 1]), c = vertex(faces_[3 * f + 2]);
            const double side = std::max({dot(b - a, b - a), dot(c - b, c - b), dot(a - c, a - c)});
            if (side > 0) ++block.faces, block.powers += int64_t(std::bit_cast<uint64_t>(side) >> 52) - 1023;
            double w = 1 / side;
            if (!(w <= std::numeric_limits<double>::max())) w = 0;  // a single point
            block.weight += w;
            block.sum += w * (a - base + (b - base) + (c - base));
        }
        block.sum = (1.0 / 3) * block.sum;
        return block;
    });
    Block all;
    for (const Block& b : of_faces)
        all.sum += b.sum, all.weight += b.weight, all.faces += b.faces, all.powers += b.powers;
    auto& [centre, unit, radius] = frame_;
    centre = base + (1 / all.weight) * all.sum;
    if (!std::isfinite(centre.x + centre.y + centre.z)) centre = base;

    const Vec3 from = centre;
    const std::vector<double> farthest = team.of_blocks(n_verts_, [&](int64_t first, int64_t last) {
        double most = 0;
        for (int64_t v = first; v < last; ++v) {
            if (!uses(v)) continue;
            const Vec3 p = vertex(v) - from;
            most = std::max(most, dot(p, p));
        }
        return most;
    });
    unit = std::sqrt(*std::max_element(farthest.begin(), farthest.end())), radius = 1;
    if (!(unit > 0)) unit = 1;  // a single point
    if (!all.faces) return;
    constexpr int ordinary = 20, most = 70, most_of_radius = 36;  // powers of two
    const double size = double(all.powers) / (2 * double(all.faces)), span = std::log2(unit) - size;
    if (span > most) {
        char text[256];
        std::snprintf(text, sizeof text,
                      "verts: expected faces within 1e21 times their size of each other, got a vertex %.1e away from "
                      "faces of about %.1e; leave out what is so far or bring it nearer",
                      unit, std::exp2(size));
        throw std::invalid_argument(text);
    }
    if (span <= ordinary) return;
    radius = std::exp2(std::min(int(span / 2), most_of_radius));
    unit /= radius;
}

void RayCaster::update(const double* verts, Team& team) {
    set_frame(verts, team);
    team.each_block(n_verts_, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t v = first; v < last; ++v) {
            if (!uses(v)) continue;  // may be farther than floats reach
            const Vec3 p = frame_.position({verts[3 * v], verts[3 * v + 1], verts[3 * v + 2]});
            positions_[3 * v] = float(p.x), positions_[3 * v + 1] = float(p.y), positions_[3 * v + 2] = float(p.z);
        }
    });
    stop_ = false;  // what Embree's threads read comes after this, also for ThreadSanitizer, which cannot watch Embree
    // Embree asks from any of its threads and holds locks of its own meanwhile. So that this one can ask the caller,
    // whose signal handlers may render, another one builds what takes long.
    if (n_faces_ < int64_t(1) << 18) return build();
    auto built = std::async(std::launch::async, [&] { build(); });
    try {
        while (built.wait_for(std::chrono::milliseconds(20)) == std::future_status::timeout) team.check();
    } catch (...) {
        stop_ = true;
        built.wait();
        throw;
    }
    built.get();
}

void RayCaster::build() {
    const std::lock_guard lock(embree_mutex);
    if (committed_) rtc.rtcUpdateGeometryBuffer(static_cast<Geometry>(geometry_), BUFFER_TYPE_VERTEX, 0);
    {
        [[maybe_unused]] const NamedWorkers named;
        rtc.rtcCommitGeometry(static_cast<Geometry>(geometry_));
        rtc.rtcCommitScene(static_cast<Scene>(scene_));
    }
    last_build = std::chrono::steady_clock::now();
    throw_on_error("building the ray structure");
    committed_ = true;
}

template <int W>
RayPacket<W>::RayPacket() {
    std::fill(mask, mask + W, ~0u);
    std::fill(instance, instance + W, INVALID_GEOMETRY_ID);
    std::fill(instance_primitive, instance_primitive + W, INVALID_GEOMETRY_ID);
    std::iota(id, id + W, 0u);
}

RayBatch::RayBatch(int width) {
    if (width == 16) packets_.emplace<Packets<16>>();
}

void RayBatch::set(int i, const RayFrame& frame, const Ray& ray) {
    const double scale = length(ray.direction);
    const Vec3 d = (1 / scale) * ray.direction;
    Vec3 o = frame.position(ray.origin);
    double end = ray.end * scale / frame.unit;
    if (frame.is_far(o)) {
        const double start = std::max(0.0, frame.start(o, d));
        o += start * d, end -= start;
    }
    const auto write = [&](auto& packet, int k) {
        packet.origin_x[k] = float(o.x), packet.origin_y[k] = float(o.y), packet.origin_z[k] = float(o.z);
        packet.direction_x[k] = float(d.x), packet.direction_y[k] = float(d.y), packet.direction_z[k] = float(d.z);
        packet.t_far[k] = float(std::clamp(end, -1.0, double(std::numeric_limits<float>::max()))),
        packet.geometry[k] = INVALID_GEOMETRY_ID;
    };
    if (auto* wide = std::get_if<Packets<16>>(&packets_)) write((*wide)[i / 16], i % 16);
    else write(std::get<Packets<8>>(packets_)[i / 8], i % 8);
}

// Always inlined, so that it is compiled for each of the processors that read_faces() below is for.
template <int W>
[[gnu::always_inline]] inline void RayBatch::read_faces(const Packets<W>& packets) {
    for (int k = 0; k < count; k += W) {
        const RayPacket<W>& p = packets[k / W];
        EDGEGRAD_ROLLED for (int i = 0; i < W; ++i) face[k + i] =
            p.geometry[i] == INVALID_GEOMETRY_ID ? -1 : int32_t(p.triangle[i]);
    }
}

EDGEGRAD_VECTORIZED void RayBatch::read_faces() {
    if (auto* wide = std::get_if<Packets<16>>(&packets_)) read_faces<16>(*wide);
    else read_faces<8>(std::get<Packets<8>>(packets_));
}

namespace {

// valid_lanes.first[n]: the first n of 16 lanes are on. Embree wants them aligned as its vectors are.
struct ValidLanes {
    alignas(64) int first[17][16] = {};
    constexpr ValidLanes() {
        for (int n = 0; n <= 16; ++n)
            for (int i = 0; i < n; ++i) first[n][i] = -1;
    }
} constexpr valid_lanes;

struct RejectContext {
    RayQueryContext query;                                   // first, so that a pointer to it is a pointer to this
    const RayCaster::Ignored* ignored;                       // by ray, or null
    bool (*meets)(const void* data, int ray, int32_t face);  // or null
    const void* data;
    int first = 0;  // of the packet's rays in the batch
};

void reject(const FilterArguments* a) {
    auto* context = reinterpret_cast<RejectContext*>(a->context);
    const auto* id = static_cast<const unsigned*>(a->ray) + 10 * a->N;
    const auto* face = static_cast<const unsigned*>(a->hit) + 5 * a->N;
    for (unsigned i = 0; i < a->N; ++i) {
        if (!a->valid[i]) continue;
        const int32_t f = int32_t(face[i]);
        bool found = false;
        if (context->ignored) {
            // Most are the two faces of an edge; longer lists come sorted.
            const auto& ignored = context->ignored[id[i]];
            found = ignored.size() > 16 ? std::binary_search(ignored.begin(), ignored.end(), f)
                                        : std::find(ignored.begin(), ignored.end(), f) != ignored.end();
        }
        if (!found && context->meets) found = !context->meets(context->data, context->first + int(id[i]), f);
        if (found) a->valid[i] = 0;
    }
}

}  // namespace

void RayCaster::trace(RayBatch& batch, Query query, const Ignored* ignored, const Decision* meets) const {
    RejectContext context{{{INVALID_GEOMETRY_ID}, {INVALID_GEOMETRY_ID}}, nullptr, nullptr, nullptr};
    if (meets) context.meets = meets->call, context.data = meets->data;
    const bool any = ignored || meets;
    const int flags = RAY_QUERY_FLAG_COHERENT | (any ? RAY_QUERY_FLAG_INVOKE_ARGUMENT_FILTER : 0);
    IntersectArguments arguments{flags, FEATURE_FLAG_ALL, &context.query, any ? reject : nullptr, nullptr, 0};
    const auto each = [&](auto& packets, int width, auto ask) {
        for (int k = 0; k < batch.count; k += width) {
            if (ignored) context.ignored = ignored + k;
            context.first = k;
            ask(valid_lanes.first[std::min(width, batch.count - k)], static_cast<Scene>(scene_), &packets[k / width],
                &arguments);
        }
    };
    const bool closest = query == Query::closest;
    if (auto* wide = std::get_if<RayBatch::Packets<16>>(&batch.packets_))
        each(*wide, 16, closest ? rtc.rtcIntersect16 : rtc.rtcOccluded16);
    else each(std::get<RayBatch::Packets<8>>(batch.packets_), 8, closest ? rtc.rtcIntersect8 : rtc.rtcOccluded8);
}

void RayCaster::cast(RayBatch& batch, const Ignored* ignored) const {
    trace(batch, Query::closest, ignored, nullptr);
    batch.read_faces();
}

void RayCaster::cast(RayBatch& batch, const Ignored* ignored, const Decision& meets) const {
    trace(batch, Query::closest, ignored, &meets);
    batch.read_faces();
}

void RayCaster::cast_occluded(RayBatch& batch, const Ignored* ignored) const { cast_occluded(batch, ignored, nullptr); }

// Embree moves the end of a ray that met something to −∞.
void RayCaster::cast_occluded(RayBatch& batch, const Ignored* ignored, const Decision* meets) const {
    trace(batch, Query::any, ignored, meets);
    std::visit(
        [&](const auto& packets) {
            const int width = RayBatch::size / int(packets.size());
            for (int i = 0; i < batch.count; ++i)
                batch.hidden[i] = packets[i / width].t_far[i % width] == -std::numeric_limits<float>::infinity();
        },
        batch.packets_);
}

}  // namespace edgegrad
