// An artifact's test vectors: inputs and the outputs that they must give.
#pragma once

#include <filesystem>
#include <functional>

#include "model.hpp"

using Run = std::function<Outputs(const Inputs&)>;

// Run every test vector and print a line; whether all came out as stored.
bool check(const std::filesystem::path& artifact, const Json& contract, const Run& run);
