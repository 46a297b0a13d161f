// SPDX-License-Identifier: Apache-2.0
//
// Gazebo classic 11 in lock-step with the program at the other end of its standard input and output.
//
// Owns the engine: one world, stepped when it is told to and never otherwise. It knows nothing of the mesh; what the
// numbers mean there is fmu_mesh/instances/gazebo/gazebo_classic.py. All is text, one command or answer per line, and numbers have
// 17 digits, so that they arrive as they were sent:
//
//   > world <bytes>                         and then so many bytes of SDF
//   > joint <model>::<joint> limited|free   any number of times; free: whatever velocity limit its file says; a model in
//   > link <model>::<link>                  a model is <outer>::<inner>
//   > go                                    loads the world
//   < gazebo <version> <engine>
//   < <state>                               the state as loaded
//   > step_size <s>                         from now on; no answer
//   > step <count> <numbers>                the effort of each joint; force x y z and moment x y z of each link
//   < <state>                               after so many steps, with these numbers in each of them
//
// A state has for each joint position, velocity and the acceleration of the last step, and for each link the position
// x y z of its origin, its attitude w x y z, its linear velocity and its angular velocity, all in world axes and SI
// units. Forces act at the origin of their link, and they and the moments are in its axes. Efforts are applied as they
// are: limits of effort are the other side's. "error <text>" is the last answer of all; the end of standard input ends
// the program.

#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include <gazebo/common/common.hh>
#include <gazebo/gazebo.hh>
#include <gazebo/gazebo_config.h>
#include <gazebo/physics/physics.hh>

namespace {

using gazebo::physics::JointPtr;
using gazebo::physics::LinkPtr;
using gazebo::physics::ModelPtr;
using gazebo::physics::WorldPtr;
using ignition::math::Vector3d;

// Where world file and logs are; gone when the program ends.
class PrivateFolder {
 public:
  PrivateFolder() {
    std::string name = (std::filesystem::temp_directory_path() / "fmu_mesh_gazebo_XXXXXX").string();
    if (mkdtemp(name.data()) == nullptr) throw std::runtime_error("cannot make a folder like " + name);
    path = name;
  }
  ~PrivateFolder() {
    std::error_code ignored;
    std::filesystem::remove_all(path, ignored);
  }
  PrivateFolder(const PrivateFolder &) = delete;
  PrivateFolder &operator=(const PrivateFolder &) = delete;

  std::filesystem::path path;
};

struct Asked {
  std::string world;
  std::vector<std::string> joints, links;
  std::vector<bool> free;  // of each joint
};

// The part that get finds by its name in a model of the world. Both names may have "::" in them: a model may be in a
// model, and a link of an expanded file may be called after the model that it came from.
template <typename Part>
Part part_named(const WorldPtr &world, const std::string &scoped, Part (*get)(const ModelPtr &, const std::string &)) {
  for (auto colons = scoped.rfind("::"); colons != std::string::npos && colons > 0;
       colons = scoped.rfind("::", colons - 1)) {
    const auto model = world->ModelByName(scoped.substr(0, colons));
    const auto part = model ? get(model, scoped.substr(colons + 2)) : Part();
    if (part) return part;
  }
  throw std::runtime_error("the world has no " + scoped);
}

class World {
 public:
  World(const Asked &asked, const std::filesystem::path &folder) {
    const auto file = folder / "world.sdf";
    std::ofstream(file, std::ios::binary) << asked.world;
    world_ = gazebo::loadWorld(file.string());
    if (!world_) throw std::runtime_error("Gazebo cannot load this world");
    world_->Physics()->SetRealTimeUpdateRate(0);
    for (const auto &scoped : asked.joints) {
      joints_.push_back(part_named<JointPtr>(
          world_, scoped, [](const ModelPtr &model, const std::string &name) { return model->GetJoint(name); }));
      joints_.back()->SetEffortLimit(0, -1.0);
      if (asked.free[joints_.size() - 1]) joints_.back()->SetVelocityLimit(0, -1.0);
    }
    for (const auto &scoped : asked.links)
      links_.push_back(part_named<LinkPtr>(
          world_, scoped, [](const ModelPtr &model, const std::string &name) { return model->GetLink(name); }));
    accelerations_.resize(joints_.size());
  }

  std::string engine() const { return world_->Physics()->GetType(); }

  void set_step_size(double seconds) { world_->Physics()->SetMaxStepSize(seconds); }

  void step(long count, const std::vector<double> &efforts, const std::vector<double> &wrenches) {
    std::vector<double> before(joints_.size());
    for (long i = 0; i < count; ++i) {
      // Whatever was applied in the last step is over: the engine forgets it, and this is all that acts in the next.
      for (size_t j = 0; j < joints_.size(); ++j) {
        joints_[j]->SetForce(0, efforts[j]);
        before[j] = joints_[j]->GetVelocity(0);
      }
      for (size_t j = 0; j < links_.size(); ++j) push(links_[j], &wrenches[6 * j]);
      gazebo::runWorld(world_, 1);
      const double seconds = world_->Physics()->GetMaxStepSize();
      for (size_t j = 0; j < joints_.size(); ++j)
        accelerations_[j] = (joints_[j]->GetVelocity(0) - before[j]) / seconds;
    }
  }

  std::string state() const {
    std::ostringstream text;
    text.precision(17);
    for (size_t j = 0; j < joints_.size(); ++j)
      text << joints_[j]->Position(0) << ' ' << joints_[j]->GetVelocity(0) << ' ' << accelerations_[j] << ' ';
    for (const auto &link : links_) {
      const auto pose = link->WorldPose();
      const auto q = pose.Rot();
      write(text, pose.Pos());
      text << q.W() << ' ' << q.X() << ' ' << q.Y() << ' ' << q.Z() << ' ';
      write(text, link->WorldLinearVel());
      write(text, link->WorldAngularVel());
    }
    return text.str();
  }

 private:
  // By component: as a whole, vectors are equal up to 1e-3.
  static bool acts(const Vector3d &v) { return v.X() != 0.0 || v.Y() != 0.0 || v.Z() != 0.0; }

  // By component: as a whole, a vector is written rounded.
  static void write(std::ostream &text, const Vector3d &v) { text << v.X() << ' ' << v.Y() << ' ' << v.Z() << ' '; }

  void push(const LinkPtr &link, const double *wrench) const {
    const Vector3d force(wrench[0], wrench[1], wrench[2]), moment(wrench[3], wrench[4], wrench[5]);
    if (world_->Physics()->GetType() == "simbody") {
      // Of Gazebo's functions, Simbody has only these two; the others do nothing. A force acts at the origin of the link,
      // and the moment comes first: it replaces the force.
      const auto rotation = link->WorldPose().Rot();
      if (acts(moment)) link->SetTorque(rotation.RotateVector(moment));
      if (acts(force)) link->AddForce(rotation.RotateVector(force));
      return;
    }
    if (acts(force)) link->AddLinkForce(force);
    if (acts(moment)) link->AddRelativeTorque(moment);
  }

  WorldPtr world_;
  std::vector<JointPtr> joints_;
  std::vector<LinkPtr> links_;
  std::vector<double> accelerations_;
};

// What comes before "go".
Asked read_asked() {
  Asked asked;
  for (std::string line; std::getline(std::cin, line);) {
    std::istringstream words(line);
    std::string command, name, limits;
    words >> command;
    if (command == "go") return asked;
    if (command == "world") {
      size_t size = 0;
      if (!(words >> size)) throw std::runtime_error("world without its size");
      asked.world.resize(size);
      std::cin.read(asked.world.data(), static_cast<std::streamsize>(size));
    } else if (command == "joint" && words >> name >> limits) {
      asked.joints.push_back(name);
      asked.free.push_back(limits == "free");
    } else if (command == "link" && words >> name) {
      asked.links.push_back(name);
    } else {
      throw std::runtime_error("unknown command before go: " + line);
    }
  }
  throw std::runtime_error("standard input ended before go");
}

// strtod and not a stream, which would refuse what is no finite number.
std::vector<double> read_numbers(std::istringstream &words, size_t count) {
  std::vector<double> numbers;
  for (std::string word; numbers.size() < count && words >> word;)
    numbers.push_back(std::strtod(word.c_str(), nullptr));
  if (numbers.size() != count) throw std::runtime_error("a step with too few numbers");
  return numbers;
}

void serve(std::FILE *answers) {
  const auto answer = [answers](const std::string &text) {
    std::fprintf(answers, "%s\n", text.c_str());
    std::fflush(answers);
  };
  try {
    const PrivateFolder folder;
    for (const char *variable : {"HOME", "TMPDIR", "GAZEBO_LOG_PATH"}) setenv(variable, folder.path.c_str(), 1);
    const Asked asked = read_asked();
    if (!gazebo::setupServer()) throw std::runtime_error("Gazebo's server does not start");
    World world(asked, folder.path);
    answer(std::string("gazebo ") + GAZEBO_VERSION_FULL + " " + world.engine());
    answer(world.state());
    for (std::string line; std::getline(std::cin, line);) {
      std::istringstream words(line);
      std::string command;
      words >> command;
      if (command == "step_size") {
        world.set_step_size(read_numbers(words, 1)[0]);
      } else if (command == "step") {
        const auto count = static_cast<long>(read_numbers(words, 1)[0]);
        const auto efforts = read_numbers(words, asked.joints.size());
        const auto wrenches = read_numbers(words, 6 * asked.links.size());
        world.step(count, efforts, wrenches);
        answer(world.state());
      } else {
        throw std::runtime_error("unknown command: " + line);
      }
    }
  } catch (const gazebo::common::Exception &error) {
    answer("error " + error.GetErrorStr());
  } catch (const std::exception &error) {
    answer(std::string("error ") + error.what());
  }
}

}  // namespace

int main() {
  // Answers have a file of their own: Gazebo and its libraries write to standard output as they like.
  std::FILE *answers = fdopen(dup(STDOUT_FILENO), "w");
  if (answers == nullptr || dup2(STDERR_FILENO, STDOUT_FILENO) < 0) return 1;
  serve(answers);
  std::fclose(answers);
  // Gazebo's threads and static objects do not always come to an end by themselves, and there is nothing left to save.
  std::_Exit(0);
}
