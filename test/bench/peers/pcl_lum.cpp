// SPDX-FileCopyrightText: 2026 surfel_mapper contributors
// SPDX-License-Identifier: Apache-2.0
//
// Times pcl::registration::LUM on a graph that comes on stdin, as test/bench/lum.py writes it:
//
//   VERTICES EDGES PAIRS ITERATIONS REPEATS
//   the ends of every edge, then the points of every vertex, PAIRS times x y z
//
// Point k of a vertex belongs to point k of any other. Prints the milliseconds of
// processor time of each compute().

#include <pcl/point_types.h>
#include <pcl/registration/lum.h>

#include <cstdio>
#include <ctime>
#include <iostream>
#include <utility>
#include <vector>

using Cloud = pcl::PointCloud<pcl::PointXYZ>;

int main() {
  int vertices, edges, pairs, iterations, repeats;
  std::cin >> vertices >> edges >> pairs >> iterations >> repeats;
  std::vector<std::pair<int, int>> ends(edges);
  for (auto& end : ends) std::cin >> end.first >> end.second;
  std::vector<Cloud::Ptr> clouds;
  for (int v = 0; v < vertices; ++v) {
    clouds.emplace_back(new Cloud);
    for (int k = 0; k < pairs; ++k) {
      pcl::PointXYZ point;
      std::cin >> point.x >> point.y >> point.z;
      clouds.back()->push_back(point);
    }
  }
  if (!std::cin) return 2;
  pcl::CorrespondencesPtr same(new pcl::Correspondences);
  for (int k = 0; k < pairs; ++k) same->push_back(pcl::Correspondence(k, k, 0.0f));
  for (int repeat = 0; repeat < repeats; ++repeat) {
    pcl::registration::LUM<pcl::PointXYZ> lum;
    lum.setMaxIterations(iterations);
    for (const auto& cloud : clouds) lum.addPointCloud(cloud);
    for (const auto& end : ends) lum.setCorrespondences(end.first, end.second, same);
    const std::clock_t start = std::clock();
    lum.compute();
    std::printf("%.4f\n", 1e3 * (std::clock() - start) / CLOCKS_PER_SEC);
  }
}
