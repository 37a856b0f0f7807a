// One call per step instead of some six hundred: tell changed speeds, step, read everything back and compare it.
//
// The functions are SUMO's own, taken from the copy of libsumo that Python has already loaded, so that they act on the
// same simulation; only their names are needed, no SUMO headers. Vehicles are looked up by name once, by libsumo's own
// look-up. Everything here is also done in Python (harness/worlds/sumo.py); tests hold the two against each other, bit
// for bit.

#include <dlfcn.h>

#include <cstring>
#include <exception>
#include <limits>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace {

struct Vehicle;     // SUMO's MSVehicle
struct Influencer;  // what a vehicle has been told from outside

using TimeLine = std::vector<std::pair<long long, double>>;
using GetVehicle = Vehicle* (*)(const std::string&);
using GetInfluencer = Influencer* (*)(Vehicle*);
using SetSpeedTimeLine = void (*)(Influencer*, const TimeLine&);
using Get = double (*)(const Vehicle*);
using Is = bool (*)(const Vehicle*);
using Step = void (*)(double);
using Count = int (*)();

constexpr long long NEVER = std::numeric_limits<long long>::max() / 2;
enum Answer { OBEYED = 0, FAILED = 1, DIFFERS = 2 };

struct Shim {
    GetVehicle getVehicle;
    GetInfluencer getInfluencer;
    SetSpeedTimeLine setSpeedTimeLine;
    Get getPositionOnLane;
    Get getSpeed;
    Is isOnRoad;
    Step step;
    Count getArrivedNumber;
    const void* const* vtable;
    std::vector<std::string> names;
    std::vector<Vehicle*> vehicles;
    TimeLine always = {{0, 0.0}, {NEVER, 0.0}};
    const TimeLine nothing;
    std::string error;
};

template <class Function>
bool find(void* library, const char* symbol, Function& function) {
    function = reinterpret_cast<Function>(dlsym(library, symbol));
    return function != nullptr;
}

// A vehicle whose class is MSVehicle itself: its address is then that of its one base class too, as libsumo hands it out.
bool isMicroscopic(const Shim& shim, const Vehicle* vehicle) {
    const void* table = nullptr;
    std::memcpy(&table, vehicle, sizeof table);
    return table == shim.vtable + 2;  // behind the offset to the top and the type information
}

// What libsumo's Vehicle::setSpeed does: one speed from now on, or, below zero, none.
void setSpeed(Shim& shim, Vehicle* vehicle, double speed) {
    shim.always[0].second = shim.always[1].second = speed;
    shim.setSpeedTimeLine(shim.getInfluencer(vehicle), speed >= 0.0 ? shim.always : shim.nothing);
}

}  // namespace

#define STD_STRING "NSt7__cxx1112basic_stringIcSt11char_traitsIcESaIcEEE"

extern "C" {

// A shim for the given vehicles, or null if this libsumo does not have the functions.
void* shim_open(const char* libsumo_path, const char* const* names, long n) {
    void* library = dlopen(libsumo_path, RTLD_NOW | RTLD_NOLOAD);
    if (library == nullptr) {
        return nullptr;
    }
    auto* shim = new Shim;
    if (!find(library, "_ZN7libsumo6Helper10getVehicleERK" STD_STRING, shim->getVehicle) ||
        !find(library, "_ZN9MSVehicle13getInfluencerEv", shim->getInfluencer) ||
        !find(library, "_ZN9MSVehicle10Influencer16setSpeedTimeLineERKSt6vectorISt4pairIxdESaIS3_EE",
              shim->setSpeedTimeLine) ||
        !find(library, "_ZNK9MSVehicle17getPositionOnLaneEv", shim->getPositionOnLane) ||
        !find(library, "_ZNK9MSVehicle8getSpeedEv", shim->getSpeed) ||
        !find(library, "_ZNK9MSVehicle8isOnRoadEv", shim->isOnRoad) ||
        !find(library, "_ZN7libsumo10Simulation4stepEd", shim->step) ||
        !find(library, "_ZN7libsumo10Simulation16getArrivedNumberEv", shim->getArrivedNumber) ||
        !find(library, "_ZTV9MSVehicle", shim->vtable)) {
        delete shim;
        return nullptr;
    }
    shim->names.assign(names, names + n);
    return shim;
}

// Look the vehicles up by name, anew after every load. Returns OBEYED, or FAILED with a message for shim_error.
int shim_find_vehicles(void* handle) {
    auto* shim = static_cast<Shim*>(handle);
    shim->vehicles.clear();
    try {
        for (const std::string& name : shim->names) {
            Vehicle* vehicle = shim->getVehicle(name);
            if (!isMicroscopic(*shim, vehicle)) {
                throw std::runtime_error("vehicle '" + name + "' is not microscopic");
            }
            shim->vehicles.push_back(vehicle);
        }
        return OBEYED;
    } catch (const std::exception& exception) {
        shim->vehicles.clear();
        shim->error = exception.what();
        return FAILED;
    }
}

// Tell the speeds that differ from `told` (and note them there), step, read positions and speeds into `x` and `v`, and
// compare them with what is wanted. Returns OBEYED if all are equal, DIFFERS if not, or FAILED.
int shim_step(void* handle, const double* speed, double* told, const double* wanted_x, const double* wanted_v, double* x,
              double* v) {
    auto* shim = static_cast<Shim*>(handle);
    const std::size_t n = shim->names.size();
    if (shim->vehicles.size() != n) {
        return FAILED;  // shim->error says since when
    }
    try {
        for (std::size_t i = 0; i < n; ++i) {
            if (speed[i] != told[i]) {
                setSpeed(*shim, shim->vehicles[i], speed[i]);
                told[i] = speed[i];
            }
        }
        shim->step(0.0);
        if (shim->getArrivedNumber() > 0) {  // SUMO has deleted vehicles that `vehicles` still points at
            shim->vehicles.clear();
            shim->error = "a vehicle has left the road";
            return FAILED;
        }
        bool obeyed = true;
        for (std::size_t i = 0; i < n; ++i) {
            const Vehicle* vehicle = shim->vehicles[i];
            x[i] = shim->isOnRoad(vehicle) ? shim->getPositionOnLane(vehicle) : std::numeric_limits<double>::quiet_NaN();
            v[i] = shim->getSpeed(vehicle);
            obeyed = obeyed && x[i] == wanted_x[i] && v[i] == wanted_v[i];
        }
        return obeyed ? OBEYED : DIFFERS;
    } catch (const std::exception& exception) {
        shim->error = exception.what();
        return FAILED;
    }
}

const char* shim_error(void* handle) {
    return static_cast<Shim*>(handle)->error.c_str();
}

void shim_close(void* handle) {
    delete static_cast<Shim*>(handle);
}

}  // extern "C"
