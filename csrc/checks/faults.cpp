// Contains deliberate faults, built like the kernel, so that a test can show that the sanitizers report them.

#include <cstdint>
#include <vector>

#ifdef _WIN32
#define EDGEGRAD_EXPORT extern "C" __declspec(dllexport)
#else
#define EDGEGRAD_EXPORT extern "C"
#endif

EDGEGRAD_EXPORT double read_beyond(int64_t n) {
    const std::vector<double> values(n);
    return values.data()[n];
}

EDGEGRAD_EXPORT int32_t read_freed(int64_t n) {
    auto* values = new int32_t[n]();
    delete[] values;
    return static_cast<volatile int32_t*>(values)[n - 1];
}

EDGEGRAD_EXPORT int32_t overflow(int32_t n) { return n * 2; }

EDGEGRAD_EXPORT int32_t cast(double x) { return int32_t(x); }
