// Predict a recorded scene with an eqrt artifact in OpenVINO.
//
//   predict ARTIFACT SCENE.json   print where everybody will be
//   predict --check ARTIFACT...   run the artifact's test vectors; status 1 if one is missed

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <openvino/runtime/core.hpp>
#include <openvino/runtime/properties.hpp>
#include <stdexcept>

#include "scene.hpp"
#include "vectors.hpp"

namespace {

namespace fs = std::filesystem;

Json read_json(const fs::path& path) {
  std::ifstream file(path);
  if (!file) throw std::runtime_error(path.string() + ": cannot be read");
  return Json::parse(file);
}

Run load(const fs::path& artifact, const Json& contract) {
  // Without float32 said, OpenVINO computes in bfloat16 where the CPU can: metres off.
  auto model = ov::Core().compile_model((artifact / "model.onnx").string(), "CPU",
                                        ov::hint::inference_precision(ov::element::f32),
                                        ov::inference_num_threads(1));
  auto request = model.create_infer_request();
  return [request, contract](const Inputs& inputs) mutable {
    for (const auto& [name, tensor] : inputs) request.set_tensor(name, tensor);
    request.infer();
    Outputs outputs;
    for (const auto& [name, spec] : contract["outputs"].items()) {
      const ov::Tensor value = request.get_tensor(name);
      ov::Tensor copy(value.get_element_type(), value.get_shape());
      value.copy_to(copy);  // the request's own is overwritten by the next run
      outputs.push_back(copy);
    }
    return outputs;
  };
}

// A third and two thirds of the way, and the end.
void print_mode(double share, const float* places, size_t steps, double dt_s) {
  std::printf("%5.0f%%", 100 * share);
  for (size_t part : {1, 2, 3}) {
    const size_t step = std::max<size_t>(1, steps * part / 3);
    std::printf("  %.1f s (%.2f, %.2f)", step * dt_s, places[2 * step - 2], places[2 * step - 1]);
  }
  std::printf("\n");
}

void show(const fs::path& artifact, const fs::path& path) {
  const Json contract = read_json(artifact / "contract.json"), scene = read_json(path);
  const Outputs outputs = load(artifact, contract)(pack(scene, contract));
  const size_t modes = contract["num_modes"], steps = contract["horizon_steps"];
  for (size_t b = 0; b < scene["targets"].size(); ++b) {
    const Json& target = scene["targets"][b];
    const Json& now = scene["agents"][target["agent"].get<size_t>()].back();
    std::printf("agent %d at (%.2f, %.2f)\n", target["agent"].get<int>(), now[0].get<double>(),
                now[1].get<double>());
    const float* best = outputs[0].data<float>() + 2 * b * modes * steps;
    for (size_t k = 0; k < modes; ++k) {
      print_mode(outputs[1].data<float>()[b * modes + k], best + 2 * k * steps, steps,
                 contract["dt_s"]);
    }
    const size_t last = std::min(steps, target["future"].size()) - 1;
    const double x = target["future"][last][0], y = target["future"][last][1];
    std::printf("  was at (%.2f, %.2f): %.2f m away\n", x, y,
                std::hypot(best[2 * last] - x, best[2 * last + 1] - y));
  }
}

}  // namespace

int main(int count, char** arguments) try {
  const std::vector<std::string> given(arguments + 1, arguments + count);
  if (given.size() > 1 && given[0] == "--check") {
    bool good = true;
    for (size_t i = 1; i < given.size(); ++i) {
      const fs::path artifact = given[i];
      const Json contract = read_json(artifact / "contract.json");
      good = check(artifact, contract, load(artifact, contract)) && good;
    }
    return good ? 0 : 1;
  }
  if (given.size() == 2 && given[0][0] != '-') {
    show(given[0], given[1]);
    return 0;
  }
  std::fprintf(stderr, "predict ARTIFACT SCENE.json\npredict --check ARTIFACT...\n");
  return 2;
} catch (const std::exception& error) {
  std::fprintf(stderr, "predict: %s\n", error.what());
  return 1;
}
