// A ball before a row of columns. The parameters come from the command line: Declare=Azimuth=25 and
// so on; the floor is Declare=Floor_checker=1, Declare=Floor_bricks=1 or Declare=Floor_planks=1.
#version 3.7;
global_settings { assumed_gamma 1.0 }

camera {
  location vrotate(<0, 0, -7>, <Elevation, Azimuth, 0>) + <0, 0.8, 0>
  look_at <0, 0.8, 0>
  angle 45
  right x up y // square pictures
}

light_source { vrotate(<0, 0, -20>, <Sun_height, Sun, 0>) color rgb 1.1 }
background { color rgb <0.55, 0.70, 0.90> }
fog { distance 25 color rgb <0.55, 0.70, 0.90> }

plane {
  y, 0
  #ifdef (Floor_checker)
    pigment { checker color rgb 0.15, color rgb 0.85 }
  #end
  #ifdef (Floor_bricks)
    pigment { brick color rgb 0.85, color rgb <0.45, 0.12, 0.08> brick_size <1.6, 1, 0.8> mortar 0.12 }
  #end
  #ifdef (Floor_planks)
    pigment {
      gradient x
      color_map { [0.9 color rgb <0.60, 0.38, 0.18>] [0.9 color rgb <0.20, 0.10, 0.04>] }
    }
  #end
}

sphere {
  <Ball_x, Radius, Ball_z>, Radius
  pigment { color rgb <Red, Green, 0.25> }
  finish { diffuse 0.6 specular 0.8 roughness Roughness }
}

#for (I, 0, Columns - 1)
  cylinder {
    <-2.5 + 5 * I / (Columns - 1), 0, 1.8>, <-2.5 + 5 * I / (Columns - 1), 1.9, 1.8>, 0.22
    pigment { color rgb <0.90, 0.86, 0.76> }
  }
#end
