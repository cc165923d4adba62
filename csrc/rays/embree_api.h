// Declares the part of Embree's C interface (version 4, https://www.embree.org/api.html) that raycast.cpp uses. The
// library comes with the embreex wheel, which carries no headers; it is opened at run time.
#pragma once

#include <cstddef>

#include "rays/raycast.h"

namespace edgegrad::embree {

using Device = struct RTCDeviceTy*;
using Scene = struct RTCSceneTy*;
using Geometry = struct RTCGeometryTy*;

enum { DEVICE_PROPERTY_VERSION = 0, DEVICE_PROPERTY_VERSION_MAJOR = 1, DEVICE_PROPERTY_NATIVE_RAY16_SUPPORTED = 34 };
enum { BUILD_QUALITY_LOW = 0 };
enum { SCENE_FLAG_DYNAMIC = 1 << 0, SCENE_FLAG_ROBUST = 1 << 2, SCENE_FLAG_FILTER_FUNCTION_IN_ARGUMENTS = 1 << 3 };
enum { GEOMETRY_TYPE_TRIANGLE = 0 };
enum { BUFFER_TYPE_INDEX = 0, BUFFER_TYPE_VERTEX = 1 };
enum { FORMAT_UINT3 = 0x5003, FORMAT_FLOAT3 = 0x9003 };
enum { RAY_QUERY_FLAG_COHERENT = 1 << 16, RAY_QUERY_FLAG_INVOKE_ARGUMENT_FILTER = 1 << 1 };
enum { ERROR_NONE = 0, ERROR_OUT_OF_MEMORY = 4 };

constexpr unsigned INVALID_GEOMETRY_ID = ~0u;
constexpr unsigned FEATURE_FLAG_ALL = ~0u;

struct RayQueryContext {
    unsigned instID[1], instPrimID[1];
};

struct FilterArguments {
    int* valid;
    void* geometryUserPtr;
    RayQueryContext* context;
    void* ray;  // structure of arrays of length N, in the order of RayPacket
    void* hit;
    unsigned N;
};

// Matches RTCIntersectArguments and RTCOccludedArguments, which have the same layout.
struct IntersectArguments {
    int flags;
    unsigned feature_mask;
    RayQueryContext* context;
    void (*filter)(const FilterArguments*);
    void* intersect;
    float min_width_distance_factor;  // Only some builds have it; it is last, so harmless elsewhere.
};

// Lists one member per function: name, result, parameters.
#define EDGEGRAD_EMBREE_FUNCTIONS(X)                                                                         \
    X(rtcNewDevice, Device, (const char*))                                                                   \
    X(rtcGetDeviceProperty, ptrdiff_t, (Device, int))                                                        \
    X(rtcGetDeviceError, int, (Device))                                                                      \
    X(rtcNewScene, Scene, (Device))                                                                          \
    X(rtcReleaseScene, void, (Scene))                                                                        \
    X(rtcSetSceneFlags, void, (Scene, int))                                                                  \
    X(rtcSetSceneBuildQuality, void, (Scene, int))                                                           \
    X(rtcCommitScene, void, (Scene))                                                                         \
    X(rtcSetSceneProgressMonitorFunction, void, (Scene, bool (*)(void*, double), void*))                     \
    X(rtcNewGeometry, Geometry, (Device, int))                                                               \
    X(rtcReleaseGeometry, void, (Geometry))                                                                  \
    X(rtcSetSharedGeometryBuffer, void, (Geometry, int, unsigned, int, const void*, size_t, size_t, size_t)) \
    X(rtcUpdateGeometryBuffer, void, (Geometry, int, unsigned))                                              \
    X(rtcSetGeometryBuildQuality, void, (Geometry, int))                                                     \
    X(rtcSetGeometryEnableFilterFunctionFromArguments, void, (Geometry, bool))                               \
    X(rtcCommitGeometry, void, (Geometry))                                                                   \
    X(rtcAttachGeometry, unsigned, (Scene, Geometry))                                                        \
    X(rtcIntersect8, void, (const int*, Scene, void*, IntersectArguments*))                                  \
    X(rtcIntersect16, void, (const int*, Scene, void*, IntersectArguments*))                                 \
    X(rtcOccluded8, void, (const int*, Scene, void*, IntersectArguments*))                                   \
    X(rtcOccluded16, void, (const int*, Scene, void*, IntersectArguments*))

}  // namespace edgegrad::embree
