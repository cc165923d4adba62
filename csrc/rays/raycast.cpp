#include "rays/raycast.h"

#include <algorithm>
#include <chrono>
#include <future>
#include <limits>
#include <stdexcept>
#include <utility>

#include "core/thread_sanitizer.h"
#include "rays/embree_library.h"

namespace edgegrad {

using namespace embree;

RayCaster::RayCaster(const int32_t* faces, int64_t n_faces, int64_t n_verts)
    : faces_(faces),
      n_faces_(n_faces),
      n_verts_(n_verts),
      used_(n_verts, 0),
      positions_(3 * size_t(n_verts) + 1, 0.f) {  // Embree reads 16 bytes a vertex.
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
    // Low quality and dynamic builds are fast. They also make the winner of two faces at the same depth independent of
    // earlier renders.
    rtc.rtcSetGeometryBuildQuality(geometry, BUILD_QUALITY_LOW);
    rtc.rtcSetSceneBuildQuality(scene, BUILD_QUALITY_LOW);
    rtc.rtcSetSceneFlags(scene, SCENE_FLAG_DYNAMIC | SCENE_FLAG_ROBUST | SCENE_FLAG_FILTER_FUNCTION_IN_ARGUMENTS);
    rtc.rtcAttachGeometry(scene, geometry);
    const auto go_on = [](void* stop, double) {
        const bool on = !static_cast<const std::atomic<bool>*>(stop)->load();
        __tsan_release(stop);  // build() goes on after Embree's threads read it, which ThreadSanitizer cannot see.
        return on;
    };
    rtc.rtcSetSceneProgressMonitorFunction(scene, go_on, &stop_);
    throw_on_error("making a scene");
}

RayCaster::~RayCaster() {
    const std::lock_guard lock(embree_mutex);
    rtc.rtcReleaseGeometry(static_cast<Geometry>(geometry_));
    rtc.rtcReleaseScene(static_cast<Scene>(scene_));
}

void RayCaster::update(const double* verts, ThreadTeam& team) {
    frame_ = frame_of({faces_, n_faces_, verts, n_verts_, used_}, team);
    team.parallel_for_blocks(n_verts_, [&](int64_t, int64_t first, int64_t last) {
        for (int64_t v = first; v < last; ++v) {
            if (!uses(v)) continue;  // An unused vertex may be farther than floats reach.
            const Vec3 p = frame_.position({verts[3 * v], verts[3 * v + 1], verts[3 * v + 2]});
            positions_[3 * v] = float(p.x), positions_[3 * v + 1] = float(p.y), positions_[3 * v + 2] = float(p.z);
        }
    });
    stop_ = false;  // Embree's threads read after this, also for ThreadSanitizer, which cannot watch Embree.
    // Embree calls back from any of its threads and holds locks meanwhile. Another thread therefore builds what takes
    // long. This one can then ask the caller, whose signal handlers may render.
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
        const NamedWorkers named;
        rtc.rtcCommitGeometry(static_cast<Geometry>(geometry_));
        rtc.rtcCommitScene(static_cast<Scene>(scene_));
        __tsan_acquire(&stop_);
    }
    note_build();
    throw_on_error("building the ray structure");
    committed_ = true;
}

namespace {

// valid_lanes.first[n] enables the first n of 16 lanes. Embree wants them aligned like its vectors.
struct ValidLanes {
    alignas(64) int first[17][16] = {};
    constexpr ValidLanes() {
        for (int n = 0; n <= 16; ++n)
            for (int i = 0; i < n; ++i) first[n][i] = -1;
    }
} constexpr valid_lanes;

struct RejectContext {
    // It is first, so that a pointer to it is a pointer to this.
    RayQueryContext query;
    const RayCaster::Ignored* ignored;                       // indexed by ray, or null
    bool (*meets)(const void* data, int ray, int32_t face);  // may be null
    const void* data;
    int first = 0;  // index of the packet's first ray in the batch
};

void reject(const FilterArguments* a) {
    auto* context = reinterpret_cast<RejectContext*>(a->context);
    const auto* id = static_cast<const unsigned*>(a->ray) + 10 * a->N;
    const auto* face = static_cast<const unsigned*>(a->hit) + 5 * a->N;
    for (unsigned i = 0; i < a->N; ++i) {
        if (i % 4 == 0 && i + 4 <= a->N && !(a->valid[i] | a->valid[i + 1] | a->valid[i + 2] | a->valid[i + 3])) {
            i += 3;  // Four lanes are skipped at once, because most rays of a packet miss the face.
            continue;
        }
        if (!a->valid[i]) continue;
        const int32_t f = int32_t(face[i]);
        bool found = false;
        if (context->ignored) {
            // Most lists are the two faces of an edge; longer ones are sorted.
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

// Embree sets the end of a ray that hit something to −∞.
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
