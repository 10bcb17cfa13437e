// Every robot goes to the nearest free cell beside unknown ground. nlohmann/json, one header, reads the messages:
//   g++ -O2 -o nearest nearest.cpp && maexp suite run minival policy=exec:./nearest
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <nlohmann/json.hpp>
using json = nlohmann::json;

template <class T>
const T* values(const json& array) { return reinterpret_cast<const T*>(array["data"].get_binary().data()); }

json act(const json& seen) {  // one goal a robot, x and y in metres; NaN: it stays
    const int n = seen["grid"]["shape"][0], height = seen["grid"]["shape"][1], width = seen["grid"]["shape"][2];
    const double cell = seen["resolution"], left = seen["origin"][0], low = seen["origin"][1];
    json goals;
    for (int i = 0; i < n; ++i) {
        const int8_t* grid = values<int8_t>(seen["grid"]) + i * height * width;
        const double* me = values<double>(seen["poses"]) + (i * n + i) * 3;
        double best = INFINITY, goal[2] = {NAN, NAN};
        for (int y = 1; y < height - 1; ++y)
            for (int x = 1; x < width - 1; ++x) {
                const int8_t* at = grid + y * width + x;
                if (*at || (at[1] != -1 && at[-1] != -1 && at[width] != -1 && at[-width] != -1)) continue;
                const double px = left + (x + 0.5) * cell, py = low + (y + 0.5) * cell;
                const double way = std::hypot(px - me[0], py - me[1]);
                if (way < best) best = way, goal[0] = px, goal[1] = py;
            }
        goals.push_back(goal);
    }
    return {{"type", "goals"}, {"goals", goals}};
}

int main() {
    for (uint32_t size; std::fread(&size, 4, 1, stdin) == 1;) {
        std::vector<uint8_t> body(size);
        if (std::fread(body.data(), 1, size, stdin) != size) return 1;
        const json asked = json::from_msgpack(body);
        json answer = {{"type", asked["type"] == "hello" ? "hello" : "ready"}, {"version", 1}};
        if (asked["type"] == "act") answer = act(asked["observation"]);
        body = json::to_msgpack(answer);
        size = body.size();
        std::fwrite(&size, 4, 1, stdout);
        std::fwrite(body.data(), 1, size, stdout);
        std::fflush(stdout);
    }
}
