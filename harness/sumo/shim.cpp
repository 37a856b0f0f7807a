// One call per step instead of some four hundred: tell changed speeds, step, read all positions back.
//
// The functions are libsumo's own, taken from the copy of it that Python has already loaded, so that they act on the
// same simulation; only their names are needed, no SUMO headers. Everything here is also done in Python
// (harness/sumo/world.py); tests hold the two against each other, bit for bit.

#include <dlfcn.h>

#include <cstring>
#include <exception>
#include <string>
#include <vector>

namespace {

using SetSpeed = void (*)(const std::string&, double);
using Get = double (*)(const std::string&);
using Step = void (*)(double);

struct Shim {
    SetSpeed setSpeed;
    Get getLanePosition;
    Step step;
    std::vector<std::string> names;
    std::string error;
};

template <class Function>
bool find(void* library, const char* symbol, Function& function) {
    function = reinterpret_cast<Function>(dlsym(library, symbol));
    return function != nullptr;
}

}  // namespace

#define LIBSUMO_STRING "RKNSt7__cxx1112basic_stringIcSt11char_traitsIcESaIcEEE"

extern "C" {

// A shim for the given vehicles, or null if this libsumo does not have the functions.
void* shim_open(const char* libsumo_path, const char* const* names, long n) {
    void* library = dlopen(libsumo_path, RTLD_NOW | RTLD_NOLOAD);
    if (library == nullptr) {
        return nullptr;
    }
    auto* shim = new Shim;
    if (!find(library, "_ZN7libsumo7Vehicle8setSpeedE" LIBSUMO_STRING "d", shim->setSpeed) ||
        !find(library, "_ZN7libsumo7Vehicle15getLanePositionE" LIBSUMO_STRING, shim->getLanePosition) ||
        !find(library, "_ZN7libsumo10Simulation4stepEd", shim->step)) {
        delete shim;
        return nullptr;
    }
    shim->names.assign(names, names + n);
    return shim;
}

// Tell the speeds that differ from `told` (and note them there), step, and read every position into `position`.
// Returns 0, or 1 with a message for shim_error.
int shim_step(void* handle, const double* speed, double* told, double* position) {
    auto* shim = static_cast<Shim*>(handle);
    try {
        const std::size_t n = shim->names.size();
        for (std::size_t i = 0; i < n; ++i) {
            if (speed[i] != told[i]) {
                shim->setSpeed(shim->names[i], speed[i]);
                told[i] = speed[i];
            }
        }
        shim->step(0.0);
        for (std::size_t i = 0; i < n; ++i) {
            position[i] = shim->getLanePosition(shim->names[i]);
        }
        return 0;
    } catch (const std::exception& exception) {
        shim->error = exception.what();
        return 1;
    }
}

const char* shim_error(void* handle) {
    return static_cast<Shim*>(handle)->error.c_str();
}

void shim_close(void* handle) {
    delete static_cast<Shim*>(handle);
}

}  // extern "C"
