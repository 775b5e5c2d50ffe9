MODULE MainModule
  ! tool and frame as RobotStudio writes them
  PERS tooldata tGripper:=[TRUE,[[31.792631,0,229.638935],[0.945519,0,0.325568,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];
  TASK PERS wobjdata wTable:=[FALSE,TRUE,"",[[100,-50,20],[1,0,0,0]],[[0,0,0],[1,0,0,0]]];
  CONST robtarget pHome:=[[750.5,0,800],[0.5,0,0.866025404,0],[0,0,0,0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]];
  CONST robtarget pPick:=[[800.00,120.00,300.00],[0.009,0.0,1,0.0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
  CONST jointtarget jRest:=[[0,-10,15,0,35,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
  VAR robtarget pHere;
  PROC main()
    MoveAbsJ jRest\NoEOffs,v1000,z50,tool0;
    MoveJ pHome,v500,z50,tool0;
    MoveL Offs(pPick,0,0,100),v500,z10,tGripper\WObj:=wTable;
    MoveL pPick, v100, fine, tGripper \WObj:=wTable;
    pHere:=CRobT(\Tool:=tGripper);
    MoveL RelTool(pHere,0,0,-100),v100,z10,tGripper;
    MoveL [[640,80,420],[0,0,1,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],v100,fine,tool0; ! inline
  ENDPROC
ENDMODULE
